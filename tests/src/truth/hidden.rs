//! What a rig may hide.

use super::second::Second;
use super::strangers::Stranger;

/// A hidden effect, in this simulator's own equations.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(missing_docs)]
pub enum Hidden {
    DriverLag(f64),
    SlewLimit(f64),
    Saturation(f64, f64),
    /// Part that switching domains give (lost at small amplitude), mean half width of the relays \[um\].
    Preisach(f64, f64),
    Creep(f64),
    Resonance(f64, f64),
    Backlash(f64),
    Relaxation(f64, f64),
    Bubble(f64),
    Leak(f64),
    Gain(f64),
    GainDrift(f64),
    Adhesion(f64),
    FlowDrift(f64),
    Delay(f64),
    Exposure(f64),
    ClockSkew(f64),
    Drops(f64),
    Repeats(f64),
    PixelLocking(f64, f64),
    Hum(f64, f64),
    /// The command plus c of its cube \[1/um^2\].
    Stiffening(f64),
    /// A mode of the camera's stand that the PZT's motion excites: Hz, damping, share.
    Shake(f64, f64, f64),
    /// The bead jumps by c um every 997 ms.
    Jumps(f64),
    /// Another equation of an effect of the catalogue.
    Second(Second),
    /// With a memory or a chance of its own.
    Stranger(Stranger),
    // Not in the catalogue:
    /// Velocity += c d^2.
    Square(f64),
    /// Velocity += c d^3.
    Cube(f64),
    /// A line away from the mains, Hz and um.
    Line(f64, f64),
    /// Velocity gain depends on position: 1 + c sin(2 pi y / 20 um).
    Profile(f64),
    /// A force back to the start, c y + k y^3.
    Spring(f64),
    /// A second path arriving late: x(t) + c x(t - lag).
    Echo(f64, f64),
    /// Gain swings in time: 1 + c sin(2 pi t/T); c and T \[s\].
    Swing(f64, f64),
    /// Motion down the channel is faster than up.
    Valve(f64),
    /// The camera's image is curved: y + c y^2.
    Distortion(f64),
}

impl Hidden {
    /// Parameters whose equation is that of the catalogue.
    pub fn parameters(&self) -> Vec<(&'static str, f64)> {
        match *self {
            Self::DriverLag(hz) => vec![("bandwidth_hz", hz)],
            Self::SlewLimit(rate) => vec![("rate_um_per_s", rate)],
            Self::Saturation(low, high) => vec![("low_um", low), ("high_um", high)],
            Self::Resonance(hz, zeta) => vec![("frequency_hz", hz), ("damping", zeta)],
            Self::Backlash(width) => vec![("width_um", width)],
            Self::Relaxation(tau, strength) => vec![("time_s", tau), ("strength", strength)],
            Self::Bubble(tau) => vec![("lag_s", tau)],
            Self::Leak(w) => vec![("corner_rad_per_s", w)],
            Self::Gain(f) => vec![("factor", f)],
            Self::Jumps(um) => vec![("per_s", 1.0 / 0.997), ("um", um)],
            Self::GainDrift(r) => vec![("per_s", r)],
            Self::Adhesion(v) => vec![("speed_um_per_s", v)],
            Self::FlowDrift(v) => vec![("um_per_s", v)],
            Self::Delay(d) => vec![("delay_s", d)],
            Self::Exposure(e) => vec![("exposure_s", e)],
            Self::ClockSkew(ppm) => vec![("ppm", ppm)],
            Self::Drops(p) | Self::Repeats(p) => vec![("rate", p)],
            Self::PixelLocking(pixel, b) => vec![("pixel_um", pixel), ("amplitude", b)],
            Self::Hum(hz, um) => vec![("hz", hz), ("um", um)],
            Self::Stiffening(c) => vec![("per_um2", c)],
            Self::Swing(depth, period) => vec![("depth", depth), ("period_s", period)],
            Self::Valve(c) => vec![("asymmetry", c)],
            Self::Shake(hz, zeta, share) => {
                vec![("frequency_hz", hz), ("damping", zeta), ("share", share)]
            }
            Self::Second(second) => second.parameters(),
            Self::Stranger(stranger) => stranger.parameters(),
            _ => Vec::new(),
        }
    }

    /// The id of the vocabulary, or `outside`.
    pub fn id(&self) -> &'static str {
        match self {
            Self::DriverLag(_) => "driver-lag",
            Self::SlewLimit(_) => "slew-limit",
            Self::Saturation(..) => "saturation",
            Self::Preisach(..) => "pzt-hysteresis",
            Self::Creep(_) => "pzt-creep",
            Self::Resonance(..) => "pzt-resonance",
            Self::Backlash(_) => "backlash",
            Self::Relaxation(..) => "pdms-relaxation",
            Self::Bubble(_) => "bubble",
            Self::Leak(_) => "leak",
            Self::Gain(_) => "gain-error",
            Self::GainDrift(_) => "gain-drift",
            Self::Adhesion(_) => "wall-adhesion",
            Self::FlowDrift(_) => "flow-drift",
            Self::Delay(_) => "time-delay",
            Self::Exposure(_) => "exposure-averaging",
            Self::ClockSkew(_) => "clock-skew",
            Self::Drops(_) => "frame-drops",
            Self::Repeats(_) => "frame-repeats",
            Self::PixelLocking(..) => "pixel-locking",
            Self::Hum(..) => "mains-hum",
            Self::Cube(_) | Self::Stiffening(_) => "stiffening",
            Self::Swing(..) => "gain-swing",
            Self::Shake(..) => "camera-shake",
            Self::Second(second) => second.id(),
            Self::Stranger(stranger) => stranger.id(),
            Self::Valve(_) => "valve-asymmetry",
            Self::Jumps(_) => "jumps",
            _ => "outside",
        }
    }
}
