//! Measured records of other systems, whose missing effect is known (see the README beside them): no false name on any of
//! them, on any half, in any order.

use cellpos_ident::foreign::{ForeignSettings, identify};
use cellpos_ident::sampled::Hold;
use cellpos_plant::effects::Definition;
use cellpos_plant::{Model, Noise, SimulateOptions, TransferFunction, effects, simulate};
use cellpos_reconcile::{Options, ReconcileError, Reconciliation, Record, Verdict, reconcile};
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

fn data() -> PathBuf {
    Path::new(env!("MEASURED_DATA")).join("measured")
}

/// Columns of input and output of a file.
fn columns(path: &Path, input: &str, output: &str) -> (Vec<f64>, Vec<f64>) {
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').map(str::trim).collect();
    let at = |name: &str| names.iter().position(|n| *n == name).unwrap();
    let (i, o) = (at(input), at(output));
    lines
        .map(|l| {
            let cells: Vec<f64> = l.split(',').map(|c| c.trim().parse().unwrap()).collect();
            (cells[i], cells[o])
        })
        .unzip()
}

pub(super) struct Set {
    pub(super) sample_s: f64,
    pub(super) order: usize,
    pub(super) hold: Hold,
    pub(super) files: Vec<(String, Vec<f64>, Vec<f64>)>,
}

pub(super) fn set(
    name: &str,
    files: &[&str],
    io: (&str, &str),
    sample_s: f64,
    order: usize,
    hold: Hold,
) -> Set {
    let folder = data().join(name);
    Set {
        sample_s,
        order,
        hold,
        files: files
            .iter()
            .map(|f| {
                let (u, y) = columns(&folder.join(format!("{f}.csv")), io.0, io.1);
                ((*f).to_owned(), u, y)
            })
            .collect(),
    }
}

impl Set {
    /// The linear model that `identify` fits to one of its files, as it stands in the file that it writes.
    pub(super) fn base(&self, of: usize) -> Model {
        let settings = ForeignSettings {
            rate_hz: 1.0 / self.sample_s,
            most_order: self.order,
            hold: self.hold,
        };
        let (_, u, y) = &self.files[of];
        let best = identify(u, y, &settings).unwrap().models.remove(0);
        let mut model = Model {
            name: "identified".to_owned(),
            plant: TransferFunction::new(best.numerator, best.denominator).unwrap(),
            working_point_um: u.iter().sum::<f64>() / u.len() as f64,
            noise: Noise::NONE,
            ..Model::eq6()
        };
        if best.delay_s > 0.0 {
            model = model.with_effect(effects::time_delay(best.delay_s));
        }
        println!("base: {:?} delay {}", model.plant, best.delay_s);
        model
    }

    pub(super) fn records(&self, rows: impl Fn(usize) -> std::ops::Range<usize>) -> Vec<Record> {
        self.files
            .iter()
            .map(|(name, u, y)| {
                let rows = rows(u.len());
                let t: Vec<f64> = rows.clone().map(|k| k as f64 * self.sample_s).collect();
                Record::from_rows(name, &t, &u[rows.clone()], &y[rows]).unwrap()
            })
            .collect()
    }

    pub(super) fn run(
        &self,
        model: &Model,
        records: &[Record],
    ) -> Result<Reconciliation, ReconcileError> {
        self.run_with(model, records, &[])
    }

    /// With effects of the user's own.
    fn run_with(
        &self,
        model: &Model,
        records: &[Record],
        own: &[&'static str],
    ) -> Result<Reconciliation, ReconcileError> {
        let options = Options {
            own_effects: own.to_vec(),
            max_effects: if own.is_empty() { 4 } else { 1 },
            interpolated_input: self.hold == Hold::None,
            free_start: !own.iter().any(|id| id.starts_with("tanks-overflow")),
            ..Options::default()
        };
        let start = std::time::Instant::now();
        let result = reconcile(model, records, &options, &mut |_| {});
        match &result {
            Ok(r) => {
                let names: Vec<&str> = r.effects.iter().map(|e| e.id.as_str()).collect();
                println!(
                    "{} {names:?} floor {:?} in {:.1} s; innovations {:.5} -> {:.5} (floor {:.5}), free run {:.5} -> {:.5}",
                    r.verdict.word(),
                    r.floor,
                    start.elapsed().as_secs_f64(),
                    r.gap.before,
                    r.gap.after,
                    r.gap.floor,
                    r.gap.free_run_before,
                    r.gap.free_run_after
                );
                for p in &r.places {
                    println!("    {p}");
                }
                if let Some(h) = &r.hypothesis {
                    println!("    {} ({:.2})", h.formula, h.held_out_worth);
                }
            }
            Err(e) => println!("refused: {e}"),
        }
        result
    }

    /// The whole, both halves, and the files in the other order.
    fn no_name(&self, model: &Model) {
        let mut ways: Vec<(&str, Vec<Record>)> = vec![
            ("whole", self.records(|n| 0..n)),
            ("first half", self.records(|n| 0..n / 2)),
            ("second half", self.records(|n| n / 2..n)),
        ];
        let mut turned = self.records(|n| 0..n);
        turned.reverse();
        ways.push(("turned", turned));
        for (way, records) in ways {
            println!("{way}:");
            {
                let r = self.run(model, &records).unwrap();
                assert!(
                    r.effects.is_empty(),
                    "{way}: a false name: {:?}, {:?}",
                    r.effects,
                    r.places
                );
                assert!(matches!(
                    r.verdict,
                    Verdict::Unknown | Verdict::NothingMissing
                ));
            }
        }
    }
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn a_hair_dryer_with_its_delay_has_no_name_missing() {
    let s = set(
        "hair-dryer",
        &["dryer"],
        ("u_V", "y_V"),
        0.08,
        2,
        Hold::ZeroOrder,
    );
    s.no_name(&s.base(0));
}

/// A rough linear model of a plant of which 500 rows are too few for `identify`.
pub(super) fn rough(num: f64, den: &[f64], at_rest: f64) -> Model {
    Model {
        name: "rough".to_owned(),
        plant: TransferFunction::new(vec![num], den.to_vec()).unwrap(),
        working_point_um: at_rest,
        noise: Noise::NONE,
        ..Model::eq6()
    }
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn cascaded_tanks_that_overflow_have_no_name_in_the_catalogue() {
    let s = set(
        "cascaded-tanks",
        &["tanks_Est", "tanks_Val"],
        ("u_V", "y_V"),
        4.0,
        2,
        Hold::ZeroOrder,
    );
    // Two lags of 40 and 80 s.
    s.no_name(&rough(3.0, &[3200.0, 120.0, 1.0], 3.0));
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn drives_with_a_rectifying_sensor_have_no_name_in_the_catalogue() {
    let s = set(
        "coupled-drives",
        &["drive1", "drive2", "drive3"],
        ("u_V", "z_V"),
        0.02,
        3,
        Hold::ZeroOrder,
    );
    // A belt of 1.5 Hz behind a lag of 0.3 s.
    let model = rough(1.0, &[0.0034, 0.0158, 0.33, 1.0], 0.0);
    s.no_name(&model);
    let result = s.run(&model, &s.records(|n| 0..n)).unwrap();
    assert_eq!(result.verdict, Verdict::Unknown);
    let said = result.places.join("; ");
    assert!(said.contains("without its sign"), "{said}");
}

fn silverbox() -> Set {
    set(
        "silverbox",
        &["sb_sch", "sb_sch2", "sb_ms10"],
        ("V1", "V2"),
        1.0 / 610.35,
        2,
        Hold::None,
    )
}

#[test]
#[cfg_attr(not(no_shared_data), ignore = "23 s of a debug build: for .ci/nightly")]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn a_silverbox_has_a_stiffness_that_grows_with_the_position_and_no_name_in_the_catalogue() {
    let s = set(
        "silverbox",
        &["sb_sch", "sb_sch2", "sb_ms10"],
        ("V1", "V2"),
        1.0 / 610.35,
        2,
        Hold::None,
    );
    let model = s.base(2);
    let result = s.run(&model, &s.records(|n| 0..n)).unwrap();
    assert!(result.effects.is_empty(), "{:?}", result.effects);
    assert_eq!(result.verdict, Verdict::Unknown);
    let formula = result.hypothesis.map(|h| h.formula).unwrap_or_default();
    assert!(formula.contains("y^3"), "{formula}");
}

#[test]
#[ignore = "minutes: cargo test --release -p cellpos-reconcile --test all measured -- --include-ignored"]
fn no_half_of_a_silverbox_has_a_name_in_the_catalogue() {
    let s = silverbox();
    s.no_name(&s.base(2));
}

/// Free run of a model on a record that no fit has seen: RMS error beside a level that is taken from `zero_on`.
fn free_run(model: &Model, hold: Hold, sample_s: f64, io: (&[f64], &[f64]), zero: f64) -> f64 {
    let y = free_response(model, hold, sample_s, io.0);
    let sum: f64 = y
        .iter()
        .zip(io.1)
        .map(|(s, y)| (y - s - zero).powi(2))
        .sum();
    (sum / io.1.len() as f64).sqrt()
}

/// Mean of measured less simulated positions of a fitted record: the sensor's zero.
fn mean_error(model: &Model, s: &Set, u: &[f64], y: &[f64]) -> f64 {
    let simulated = free_response(model, s.hold, s.sample_s, u);
    y.iter().zip(&simulated).map(|(y, s)| y - s).sum::<f64>() / y.len() as f64
}

pub(super) fn free_response(model: &Model, hold: Hold, sample_s: f64, u: &[f64]) -> Vec<f64> {
    /// A sampled input holds nothing above half its rate: so many steps a row, each from so many samples on each side, come close to that.
    const STEPS: usize = 20;
    const SIDE: isize = 24;
    let options = SimulateOptions::default();
    if hold != Hold::None {
        return simulate(model, u, sample_s, &options).unwrap();
    }
    let at = |k: isize| u[k.clamp(0, u.len() as isize - 1) as usize];
    // A sinc under the arch of another, of 24 samples on each side: it lets all through that is below 0.97 of half the rate.
    let sinc = |x: f64| (PI * x).sin() / (PI * x);
    let weights: Vec<Vec<f64>> = (0..STEPS)
        .map(|i| {
            let f = (i as f64 + 0.5) / STEPS as f64;
            let w =
                (1 - SIDE..=SIDE).map(|m| sinc(f - m as f64) * sinc((f - m as f64) / SIDE as f64));
            w.collect()
        })
        .collect();
    let fine: Vec<f64> = (0..u.len() as isize)
        .flat_map(|k| {
            let near: Vec<f64> = (1 - SIDE..=SIDE).map(|m| at(k + m)).collect();
            let one = move |w: &Vec<f64>| w.iter().zip(&near).map(|(w, u)| w * u).sum::<f64>();
            weights.iter().map(one).collect::<Vec<_>>()
        })
        .collect();
    let y = simulate(model, &fine, sample_s / STEPS as f64, &options).unwrap();
    y.into_iter().step_by(STEPS).collect()
}

const CUBIC: &str = r#"
[[effects]]
id = "cubic-spring"
place = "chip"
says = "a spring that hardens with the position"
output = "(1 + gain)*input - stiffness*position - damping*velocity - square*position^2 - cubic*position^3"
[effects.parameters]
square = { unit = "1/V", lower = -10.0, upper = 10.0, start = 0.0 }
gain = { unit = "", lower = -0.5, upper = 0.5, start = 0.0 }
stiffness = { unit = "1", lower = -1.0, upper = 1.0, start = 0.0 }
damping = { unit = "s", lower = -0.01, upper = 0.01, start = 0.0 }
cubic = { unit = "1/V^2", lower = -100.0, upper = 100.0, start = [1.0, 5.0] }
"#;

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn a_short_silverbox_is_named_with_a_cubic_spring_from_a_file() {
    cubic_spring(3000);
}

#[test]
#[ignore = "minutes: cargo test --release -p cellpos-reconcile -- --include-ignored measured"]
fn a_silverbox_is_named_with_a_cubic_spring_from_a_file() {
    cubic_spring(usize::MAX);
}

/// With so many rows of each record at most.
fn cubic_spring(rows: usize) {
    let s = silverbox();
    let arrow = set(
        "silverbox",
        &["sb_arrow"],
        ("V1", "V2"),
        s.sample_s,
        2,
        s.hold,
    );
    let (_, u, y) = &arrow.files[0];
    let model = s.base(2);
    let before = free_run(&model, s.hold, s.sample_s, (u, y), 0.0);
    Definition::from_toml_str(CUBIC, "cubic.toml").unwrap();
    let result = s
        .run_with(&model, &s.records(|n| 0..n.min(rows)), &["cubic-spring"])
        .unwrap();
    let after = free_run(&result.augmented, s.hold, s.sample_s, (u, y), 0.0);
    println!(
        "arrow: {:.2} mV before, {:.2} mV after",
        1e3 * before,
        1e3 * after
    );
    println!("{}", result.augmented.to_toml_string());
    assert!(
        matches!(result.verdict, Verdict::Named | Verdict::NamedWithRemainder),
        "{:?}",
        result.places
    );
    assert_eq!(result.effects.len(), 1);
    assert_eq!(result.effects[0].id, "cubic-spring");
    assert!(after < 1e-3, "{after} V");
}

/// Two tanks one above the other; what runs over the upper one's rim falls in part into the lower, and the lower runs over at
/// 10 V. Levels in volts, the pump's voltage from 3 V.
const TANKS: &str = r#"
[[effects]]
id = "tanks-overflow"
place = "plant"
says = "tanks that run over"
output = "min(lower, 10)"
step_s = 2.0
[effects.states]
upper = { rate = "pump*(input + offset) - outlet*upper - 0.25*max(upper - rim, 0)", start = "upper_0" }
lower = { rate = "outlet*upper + caught*0.25*max(upper - rim, 0) - drain*max(lower, 1e-6)^power - 0.25*max(lower - 10, 0)", start = "5.2" }
[effects.parameters]
pump = { unit = "1/s", lower = 0.005, upper = 0.1, start = 0.03 }
offset = { unit = "V", lower = 0.0, upper = 10.0, start = 3.0 }
outlet = { unit = "1/s", lower = 0.002, upper = 0.05, start = [0.007, 0.02] }
rim = { unit = "V", lower = 3.0, upper = 80.0, start = [9.0, 40.0] }
caught = { unit = "", lower = 0.0, upper = 3.0, start = 1.0 }
drain = { unit = "V/s", lower = 0.01, upper = 0.5, start = [0.05, 0.2] }
power = { unit = "", lower = 0.05, upper = 1.0, start = [0.2, 0.5] }
upper_0 = { unit = "V", lower = 0.0, upper = 80.0, start = [5.0, 30.0] }
"#;

#[test]
#[cfg_attr(
    not(no_shared_data),
    ignore = "nightly: 5 s of a debug build; the fast one starts nearer and in longer steps"
)]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn tanks_with_an_overflow_from_a_file_follow_what_they_have_not_seen() {
    tanks("tanks-overflow", TANKS);
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn tanks_with_an_overflow_that_are_roughly_known_follow_what_they_have_not_seen() {
    let mut text = TANKS.to_owned();
    for (far, near) in [
        ("tanks-overflow", "tanks-overflow-near"),
        ("step_s = 2.0", "step_s = 4.0"),
        ("0.1, start = 0.03", "0.1, start = 0.06"),
        ("[0.007, 0.02]", "0.007"),
        ("[9.0, 40.0]", "30.0"),
        ("[0.05, 0.2]", "0.1"),
        ("[0.2, 0.5]", "0.4"),
        ("[5.0, 30.0]", "20.0"),
    ] {
        assert_eq!(text.matches(far).count(), 1, "{far}");
        text = text.replace(far, near);
    }
    tanks("tanks-overflow-near", &text);
}

fn tanks(id: &'static str, text: &str) {
    let s = set(
        "cascaded-tanks",
        &["tanks_Est"],
        ("u_V", "y_V"),
        4.0,
        2,
        Hold::ZeroOrder,
    );
    let fresh = set(
        "cascaded-tanks",
        &["tanks_Val"],
        ("u_V", "y_V"),
        4.0,
        2,
        Hold::ZeroOrder,
    );
    Definition::from_toml_str(text, "tanks.toml").unwrap();
    // The noise of the level sensor, without a walk: what is scored is the free run.
    let model = Model {
        noise: Noise {
            diffusion_um2_per_s: 0.0,
            localisation_um: 0.03,
        },
        ..rough(3.0, &[3200.0, 120.0, 1.0], 3.0)
    };
    let result = s.run_with(&model, &s.records(|n| 0..n), &[id]).unwrap();
    println!("{}", result.best.to_toml_string());
    assert_eq!(result.best.effects.len(), 1);
    assert_eq!(result.best.effects[0].id(), id);
    // No name of the catalogue, with or without it.
    assert!(result.effects.iter().all(|e| e.id == id));
    let (_, u, y) = &fresh.files[0];
    let (_, u0, y0) = &s.files[0];
    let zero = mean_error(&result.best, &s, u0, y0);
    let raw = free_run(&result.best, s.hold, s.sample_s, (u, y), 0.0);
    println!("zero {zero:.3} V, without it {raw:.3} V");
    let after = free_run(&result.best, s.hold, s.sample_s, (u, y), zero);
    println!("fresh record: {after:.3} V");
    // 0.281 V; a linear model is off by 0.60 V.
    assert!(after <= 0.30, "{after} V");
}
