//! Cases that a seed draws: sets of effects, strangers, other rigs and noises.

use super::cases::{Case, Session};
use super::{Excitation, Hidden, Kind, Random, Rig, Second, Stranger};

/// Kinds of effects that are drawn, in either equation.
const KINDS: usize = 24;

/// An effect of a kind, its size between middle and strong, in the first or the second equation.
fn effect(kind: usize, random: &mut Random) -> Hidden {
    use Hidden as H;
    use Second as S;
    let second = random.uniform() < 0.5;
    if kind >= BEHIND {
        return behind(kind, second, random);
    }
    let or = |first: H, other: S| if second { H::Second(other) } else { first };
    let mut size = |low: f64, high: f64| random.between(low, high);
    match kind {
        0 => {
            let hz = size(90.0, 400.0);
            or(H::DriverLag(hz), S::CapacitiveLag(hz))
        }
        1 => {
            let rate = size(250.0, 600.0);
            or(H::SlewLimit(rate), S::GentleSlew(rate))
        }
        2 => {
            let (low, high) = (4.0 - size(1.0, 1.7), 4.0 + size(1.0, 1.7));
            or(H::Saturation(low, high), S::SoftClip(low, high))
        }
        3 => {
            let part = size(0.08, 0.25);
            or(H::Preisach(part, 1.0), S::Duhem(part))
        }
        4 => {
            let g = size(0.015, 0.05);
            or(H::Creep(g), S::PowerCreep(g))
        }
        5 => {
            let (hz, zeta) = (size(250.0, 500.0), size(0.05, 0.2));
            or(H::Resonance(hz, zeta), S::DraggedResonance(hz, zeta))
        }
        6 => {
            let um = size(0.05, 0.3);
            or(H::Backlash(um), S::RoundedPlay(um))
        }
        7 => {
            let (tau, strength) = (size(0.1, 0.5), size(0.1, 0.35));
            or(
                H::Relaxation(tau, strength),
                S::SpreadRelaxation(tau, strength),
            )
        }
        _ => {
            let tau = size(0.005, 0.04);
            or(H::Bubble(tau), S::GasSpring(tau))
        }
    }
}

/// The first kind behind the plant.
const BEHIND: usize = 9;

/// An effect of a kind on the bead or in the picture.
fn behind(kind: usize, second: bool, random: &mut Random) -> Hidden {
    use Hidden as H;
    use Second as S;
    let or = |first: H, other: S| if second { H::Second(other) } else { first };
    let mut size = |low: f64, high: f64| random.between(low, high);
    match kind {
        9 => {
            let w = size(0.5, 5.0);
            or(H::Leak(w), S::OrificeLeak(w))
        }
        10 => {
            let f = 1.0 + [-0.35, 0.3][usize::from(second)] * size(0.4, 1.4);
            or(H::Gain(f), S::Magnification(f))
        }
        11 => {
            let r = size(0.004, 0.012);
            or(H::GainDrift(-r), S::ExponentialDrift(r))
        }
        12 => {
            let v = size(10.0, 60.0);
            or(H::Adhesion(v), S::CreepingAdhesion(v))
        }
        13 => {
            let v = size(4.0, 30.0);
            or(H::FlowDrift(v), S::DrainingFlow(-v))
        }
        14 => {
            let d = size(0.001, 0.0045);
            or(H::Delay(d), S::UnsteadyDelay(d))
        }
        15 => {
            let e = size(0.0005, 0.00098);
            or(H::Exposure(e), S::ShutterRamps(e))
        }
        16 => {
            let ppm = size(60.0, 450.0);
            or(H::ClockSkew(ppm), S::SteppedSkew(-ppm))
        }
        17 => {
            let p = size(0.005, 0.04);
            or(H::Drops(p), S::DropBursts(p))
        }
        18 => {
            let p = size(0.005, 0.04);
            or(H::Repeats(p), S::RepeatBursts(p))
        }
        19 => {
            let (pixel, b) = (size(0.2, 0.4), size(0.06, 0.1));
            or(H::PixelLocking(pixel, b), S::UnevenPixels(pixel, b))
        }
        20 => {
            let um = size(0.05, 0.4);
            or(H::Hum(50.0, um), S::RichHum(60.0, um))
        }
        21 => {
            let c = size(0.02, 0.1);
            or(H::Stiffening(c), S::Sinh(c))
        }
        22 => {
            let (depth, s) = (size(0.08, 0.3), size(3.0, 9.0));
            or(H::Swing(depth, s), S::StraightSwing(depth, s))
        }
        _ => {
            let (hz, zeta, share) = (size(50.0, 200.0), size(0.03, 0.2), size(0.02, 0.1));
            or(H::Shake(hz, zeta, share), S::LooseStand(hz, zeta, share))
        }
    }
}

/// Effects whose order matters, from the driver to the bead: a stand shakes with the piezo, not with the motion behind a bubble.
const CHAIN: [&str; 17] = [
    "driver-lag",
    "slew-limit",
    "saturation",
    "pzt-hysteresis",
    "pzt-creep",
    "pzt-resonance",
    "backlash",
    "camera-shake",
    "stiffening",
    "pdms-relaxation",
    "bubble",
    "leak",
    "gain-error",
    "gain-drift",
    "gain-swing",
    "wall-adhesion",
    "flow-drift",
];

/// Whether no record of command and position can separate two effects from one with other numbers. Examples: two lags with one
/// exponential, an exposure with a lag or a delay, a play with play operators, a gain with an effect that has its own anchoring.
fn merges(a: &str, b: &str) -> bool {
    let either = |x: &str, others: &[&str]| {
        (a == x && others.contains(&b)) || (b == x && others.contains(&a))
    };
    a == b
        || either("driver-lag", &["bubble"])
        || either(
            "exposure-averaging",
            &["driver-lag", "bubble", "time-delay"],
        )
        || either("backlash", &["pzt-hysteresis"])
        || either(
            "gain-error",
            &["pzt-hysteresis", "pzt-creep", "pdms-relaxation"],
        )
}

/// Sets of the given number of effects, drawn with their sizes, equations and excitations.
pub fn sets(group: &'static str, size: usize, count: usize, seed: u64) -> Vec<Case> {
    let mut random = Random::new(seed.wrapping_mul(31).wrapping_add(size as u64));
    random.uniform();
    (0..count)
        .map(|_| {
            let mut hidden: Vec<Hidden> = Vec::new();
            while hidden.len() < size {
                let kind = random.index(KINDS);
                let next = effect(kind, &mut random);
                if !hidden.iter().any(|h| merges(h.id(), next.id())) {
                    hidden.push(next);
                }
            }
            // In the order of the chain, whatever was drawn first.
            hidden.sort_by_key(|h| CHAIN.iter().position(|id| *id == h.id()));
            Case::new(group, hidden, Session::DRAWN)
        })
        .collect()
}

/// Every kind of stranger once, its size drawn within a factor of 1.6 either way.
pub fn strangers(seed: u64) -> Vec<Case> {
    use Hidden as H;
    let mut random = Random::new(seed.wrapping_mul(37).wrapping_add(5));
    random.uniform();
    let mut factor = || random.between(1.0 / 1.6, 1.6);
    let mut all = vec![
        H::Square(60.0 * factor()),
        H::Line(37.0 * factor(), 0.15 * factor()),
        H::Profile(0.3 * factor()),
        H::Spring(0.0005 * factor()),
        H::Echo(0.3 * factor(), 0.02 * factor()),
        H::Distortion(0.003 * factor()),
    ];
    all.extend(Stranger::FOREIGN.map(|s| H::Stranger(s.times(factor()))));
    all.into_iter()
        .map(|h| Case::new("stranger", vec![h], Session::DRAWN))
        .collect()
}

/// Single effects under noises that are neither white nor normal, and with positions in steps.
pub fn noises(seed: u64) -> Vec<Case> {
    let mut random = Random::new(seed.wrapping_mul(41).wrapping_add(3));
    random.uniform();
    let sessions = [
        ("coloured", Kind::Coloured(15.0), 1e-4),
        ("tails", Kind::HeavyTails, 1e-4),
        ("steps", Kind::White, 0.05),
    ];
    (0..12)
        .map(|i| {
            let (level, noise, step_um) = sessions[i % 3];
            let session = Session {
                noise,
                step_um,
                ..Session::DRAWN
            };
            // A sensor that counts has neither pixels nor repeated frames.
            let hidden = loop {
                let kind = random.index(KINDS);
                if step_um < 0.01 || !matches!(kind, 18 | 19) {
                    break effect(kind, &mut random);
                }
            };
            Case {
                level,
                ..Case::new("noise", vec![hidden], session)
            }
        })
        .collect()
}

/// Records without rest or repeat, of a model that states no noise: a third with nothing hidden, a third with an effect, a
/// third with a stranger.
pub fn floorless(seed: u64) -> Vec<Case> {
    let mut random = Random::new(seed.wrapping_mul(43).wrapping_add(7));
    random.uniform();
    let session = Session {
        excitation: Excitation::WithoutFloor,
        ..Session::STANDARD
    };
    (0..18)
        .map(|i| {
            let hidden = match i % 3 {
                0 => Vec::new(),
                1 => {
                    let kind = random.index(KINDS);
                    vec![effect(kind, &mut random)]
                }
                _ => {
                    let odd = Stranger::FOREIGN[random.index(Stranger::FOREIGN.len())];
                    vec![Hidden::Stranger(odd)]
                }
            };
            Case::new("floorless", hidden, session)
        })
        .collect()
}

/// Bare actuators with a sensor: a free gain, effects of the driver, the piezo and the frames; a third in steps.
pub fn actuators(seed: u64) -> Vec<Case> {
    let mut random = Random::new(seed.wrapping_mul(47).wrapping_add(11));
    random.uniform();
    let kinds = [
        None,
        Some(0),
        Some(1),
        Some(2),
        Some(3),
        Some(4),
        Some(5),
        Some(6),
        Some(14),
    ];
    kinds
        .iter()
        .enumerate()
        .map(|(i, kind)| {
            let step_um = if i % 3 == 2 { 0.02 } else { 1e-4 };
            let hidden = kind.map(|k| effect(k, &mut random));
            let session = Session {
                rig: Rig::Actuator(random.between(0.2, 3.0)),
                step_um,
                ..Session::DRAWN
            };
            Case {
                level: if step_um > 0.01 { "steps" } else { "" },
                ..Case::new("actuator", hidden.into_iter().collect(), session)
            }
        })
        .collect()
}
