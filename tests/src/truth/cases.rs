//! Which effects are hidden, at which levels.

use super::Hidden;

/// One case.
#[derive(Debug, Clone)]
pub struct Case {
    /// Group: single, pair, null, outside.
    pub group: &'static str,
    /// Level of a single: weak, middle, strong.
    pub level: &'static str,
    /// What is hidden.
    pub hidden: Vec<Hidden>,
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
                    group: "single",
                    level,
                    hidden: vec![h],
                })
        })
        .collect()
}

/// Twelve pairs.
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
    .map(|p| Case {
        group: "pair",
        level: "",
        hidden: p.to_vec(),
    })
    .collect()
}

/// Nothing hidden.
pub fn nulls(count: usize) -> Vec<Case> {
    (0..count)
        .map(|_| Case {
            group: "null",
            level: "",
            hidden: Vec::new(),
        })
        .collect()
}

/// Effects that entered the catalogue later, at one level each.
pub fn further() -> Vec<Case> {
    use Hidden::*;
    cases("further", &[Cube(20.0), Breathing(0.2), Valve(0.1)])
}

/// Effects that are not in the catalogue, or that it does not look for.
pub fn outside() -> Vec<Case> {
    use Hidden::*;
    cases(
        "outside",
        &[
            Square(60.0),
            Line(37.0, 0.15),
            Profile(0.3),
            Spring(0.0005),
            Echo(0.3, 0.02),
            Distortion(0.003),
            Jumps(1.5),
        ],
    )
}

fn cases(group: &'static str, hidden: &[Hidden]) -> Vec<Case> {
    hidden
        .iter()
        .map(|h| Case {
            group,
            level: "",
            hidden: vec![*h],
        })
        .collect()
}
