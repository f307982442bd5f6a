//! Which effects are hidden, at which levels.

use super::strangers::Stranger as Odd;
use super::{Excitation, Hidden, Kind, Rig, Second};

/// Properties of a case's records other than the hidden effects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Session {
    /// The commands to the rig.
    pub excitation: Excitation,
    /// The rig.
    pub rig: Rig,
    /// Kind of the localisation noise.
    pub noise: Kind,
    /// Rounding step of a position \[um\].
    pub step_um: f64,
}

impl Session {
    /// A bead, white noise, the same excitation for every seed.
    pub const STANDARD: Self = Self {
        excitation: Excitation::Standard,
        rig: Rig::Bead,
        noise: Kind::White,
        step_um: 1e-4,
    };

    /// The same with an excitation drawn by the seed.
    pub const DRAWN: Self = Self {
        excitation: Excitation::Drawn,
        ..Self::STANDARD
    };
}

/// One case.
#[derive(Debug, Clone)]
pub struct Case {
    /// Group: single, second, further, pair, triple, null, noise, floorless, actuator, stranger.
    pub group: &'static str,
    /// Level of a single: weak, middle, strong.
    pub level: &'static str,
    /// What is hidden.
    pub hidden: Vec<Hidden>,
    /// Excitation, rig and noise.
    pub session: Session,
}

impl Case {
    /// A case of a group.
    pub fn new(group: &'static str, hidden: Vec<Hidden>, session: Session) -> Self {
        Self {
            group,
            level: "",
            hidden,
            session,
        }
    }
}

/// Weak, middle and strong of every effect of the vocabulary. Weak is twice the amplitude that can be detected at all, by
/// [`above_threshold`](super::threshold::above_threshold).
pub fn singles() -> Vec<Case> {
    use Hidden::*;
    let levels: [[Hidden; 3]; 21] = [
        [DriverLag(15000.0), DriverLag(400.0), DriverLag(90.0)],
        [SlewLimit(80000.0), SlewLimit(600.0), SlewLimit(250.0)],
        [
            Saturation(0.7, 7.3),
            Saturation(2.2, 5.8),
            Saturation(2.8, 5.0),
        ],
        [Preisach(0.01, 1.0), Preisach(0.08, 1.0), Preisach(0.2, 1.0)],
        [Creep(0.0037), Creep(0.015), Creep(0.04)],
        [
            Resonance(3350.0, 0.1),
            Resonance(600.0, 0.1),
            Resonance(260.0, 0.15),
        ],
        [Backlash(0.006), Backlash(0.06), Backlash(0.3)],
        [
            Relaxation(0.1, 0.0056),
            Relaxation(0.2, 0.1),
            Relaxation(0.4, 0.35),
        ],
        [Bubble(0.0000105), Bubble(0.006), Bubble(0.04)],
        [Leak(0.08), Leak(0.7), Leak(5.0)],
        [Gain(1.005), Gain(0.85), Gain(1.5)],
        [GainDrift(0.00063), GainDrift(-0.005), GainDrift(0.01)],
        [Adhesion(1.35), Adhesion(12.0), Adhesion(60.0)],
        [FlowDrift(0.9), FlowDrift(-5.0), FlowDrift(30.0)],
        [Delay(0.0000105), Delay(0.0013), Delay(0.0042)],
        [Exposure(0.000021), Exposure(0.0006), Exposure(0.00095)],
        [ClockSkew(-1.0), ClockSkew(-90.0), ClockSkew(400.0)],
        [Drops(0.0004), Drops(0.01), Drops(0.04)],
        [Repeats(0.001), Repeats(0.01), Repeats(0.04)],
        [
            PixelLocking(0.25, 0.015),
            PixelLocking(0.25, 0.06),
            PixelLocking(0.3, 0.1),
        ],
        [Hum(50.0, 0.007), Hum(60.0, 0.05), Hum(50.0, 0.3)],
    ];
    levels
        .into_iter()
        .flat_map(|three| {
            three
                .into_iter()
                .zip(["weak", "middle", "strong"])
                .map(|(h, level)| Case {
                    level,
                    ..Case::new("single", vec![h], Session::STANDARD)
                })
        })
        .collect()
}

/// Every effect of the catalogue in its second equation, middle and strong.
pub fn seconds() -> Vec<Case> {
    use Second::*;
    let levels: [[Second; 2]; 25] = [
        [CapacitiveLag(400.0), CapacitiveLag(90.0)],
        [GentleSlew(600.0), GentleSlew(250.0)],
        [SoftClip(2.2, 5.8), SoftClip(2.8, 5.0)],
        [Duhem(0.08), Duhem(0.2)],
        [PowerCreep(0.015), PowerCreep(0.04)],
        [DraggedResonance(600.0, 0.1), DraggedResonance(260.0, 0.15)],
        [RoundedPlay(0.06), RoundedPlay(0.3)],
        [SpreadRelaxation(0.2, 0.1), SpreadRelaxation(0.4, 0.35)],
        [GasSpring(0.006), GasSpring(0.04)],
        [OrificeLeak(0.7), OrificeLeak(5.0)],
        [Magnification(0.85), Magnification(1.5)],
        [ExponentialDrift(-0.005), ExponentialDrift(0.01)],
        [CreepingAdhesion(12.0), CreepingAdhesion(60.0)],
        [DrainingFlow(-5.0), DrainingFlow(30.0)],
        [UnsteadyDelay(0.0013), UnsteadyDelay(0.0042)],
        [ShutterRamps(0.0006), ShutterRamps(0.00095)],
        [SteppedSkew(-90.0), SteppedSkew(400.0)],
        [DropBursts(0.01), DropBursts(0.04)],
        [RepeatBursts(0.01), RepeatBursts(0.04)],
        [UnevenPixels(0.25, 0.06), UnevenPixels(0.3, 0.1)],
        [RichHum(60.0, 0.05), RichHum(50.0, 0.3)],
        [Sinh(0.02), Sinh(0.1)],
        [StraightSwing(0.1, 5.0), StraightSwing(0.25, 9.0)],
        [OpeningValve(0.01), OpeningValve(0.05)],
        [LooseStand(90.0, 0.05, 0.02), LooseStand(180.0, 0.1, 0.1)],
    ];
    levels
        .into_iter()
        .flat_map(|two| {
            two.into_iter()
                .zip(["middle", "strong"])
                .map(|(second, level)| Case {
                    level,
                    ..Case::new("second", vec![Hidden::Second(second)], Session::STANDARD)
                })
        })
        .collect()
}

/// Twelve pairs that are always the same.
pub fn pairs() -> Vec<Case> {
    use Hidden::*;
    [
        [Preisach(0.15, 1.0), Delay(0.0015)],
        [Leak(1.5), Hum(50.0, 0.1)],
        [Gain(1.2), Delay(0.002)],
        [DriverLag(200.0), FlowDrift(6.0)],
        [Adhesion(15.0), Delay(0.001)],
        [Backlash(0.1), Gain(0.8)],
        [Relaxation(0.2, 0.2), Hum(60.0, 0.1)],
        [Drops(0.02), Leak(0.8)],
        [PixelLocking(0.2, 0.08), Delay(0.002)],
        [Saturation(2.5, 5.5), Delay(0.002)],
        [GainDrift(0.006), FlowDrift(-4.0)],
        [Repeats(0.02), DriverLag(150.0)],
    ]
    .into_iter()
    .map(|p| Case::new("fixed", p.to_vec(), Session::STANDARD))
    .collect()
}

/// Nothing hidden; excitations drawn, and by turns another noise.
pub fn nulls(count: usize) -> Vec<Case> {
    let noises = [
        Session::DRAWN,
        Session {
            noise: Kind::Coloured(15.0),
            ..Session::DRAWN
        },
        Session {
            noise: Kind::HeavyTails,
            ..Session::DRAWN
        },
        Session {
            step_um: 0.05,
            ..Session::DRAWN
        },
    ];
    (0..count)
        .map(|i| Case {
            level: ["white", "coloured", "tails", "steps"][i % 4],
            ..Case::new("null", Vec::new(), noises[i % 4])
        })
        .collect()
}

/// Effects that entered the catalogue later, in the first equation.
pub fn further() -> Vec<Case> {
    use Hidden::*;
    let known = Odd::KNOWN.into_iter();
    let known = known.flat_map(|s| [s.times(1.0 / 1.6), s.times(1.6)].map(Hidden::Stranger));
    [
        Jumps(1.5),
        Cube(20.0),
        Stiffening(0.02),
        Stiffening(0.1),
        Swing(0.1, 5.0),
        Swing(0.2, 9.0),
        Valve(0.01),
        Valve(0.1),
        Shake(90.0, 0.05, 0.02),
        Shake(180.0, 0.1, 0.1),
    ]
    .into_iter()
    .chain(known)
    .map(|h| Case::new("further", vec![h], Session::STANDARD))
    .collect()
}
