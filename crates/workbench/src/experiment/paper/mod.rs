//! The figures and numbers of Mizoue et al. 2017 from the emulated rig, through frames.
//!
//! Where the paper is inconsistent the table says so with the numbers. The bead is held during the excitation: in open loop the
//! paper's 1.6 um peak to peak at 2 Hz would move it 54 um; only Fig. A1 is an open-loop record.

mod figures;
mod row;
mod table;

use super::identify::held_bead::{HeldBead, Setup};
use super::identify::{Done, Excitation, Job, page as plots, run as identify};
use cellpos_emulator::WorldConfig;
use cellpos_ident::bare_fft;
use cellpos_ident::excitation::{ExcitationLimits, PAPER_FREQUENCIES_HZ, Signal, Tone};
use cellpos_ident::experiment::{Cause, Plan, PlannedSegment, RecordedSegment};
use cellpos_ident::frequency_response::{DrivenStretch, Settings, measure};
use cellpos_plant::Model;
use cellpos_report::{Column, Emphasis, Report, Table};
use cellpos_rig::Clock;
use cellpos_session::Failure;
use serde_json::Value;
use std::path::Path;

/// The paper repeated: what was measured, and its numbers beside ours.
pub struct Paper {
    done: Done,
    drifting: Drifting,
    recorded: figures::Recorded,
    rows: Vec<row::Row>,
}

/// Repeats the paper's measurements on the emulated rig.
///
/// # Errors
/// A rig that cannot be emulated, or a bead that is lost.
pub fn measured(seed: u64) -> Result<Paper, Failure> {
    let done = identify(&job(seed), |_, _| {})?;
    let delay_s = done.result.judged.model.delay_s;
    let drifting = drifting(seed, delay_s)?;
    let recorded = figures::recorded_amplitudes();
    let rows = table::rows(&done, &drifting, &recorded)?;
    Ok(Paper {
        done,
        drifting,
        recorded,
        rows,
    })
}

/// Appendix B repeated: an open-loop record at 10 Hz with drift.
struct Drifting {
    /// Commanded displacement, um, and bead, um.
    record: RecordedSegment,
    /// Phase by the bare FFT, hold taken off, recording delay left in, deg.
    fft_deg: f64,
    /// The same with the delay taken off.
    fft_compensated_deg: f64,
    /// Phase of the same rows by sine fit with drift, hold and delay taken off, deg.
    fit_deg: f64,
    /// Drift of the rig, um/s.
    drift_um_per_s: f64,
}

fn setup(seed: u64, drift_um_per_s: f64, start_um: f64, closed_loop: bool) -> Setup {
    Setup {
        world: WorldConfig {
            seed,
            drift_um_per_s,
            start_um,
            // The paper's figures are those of its model, not of a rig that wanders.
            ..WorldConfig::ideal()
        },
        model: Model::eq6(),
        frames: true,
        clock: Clock::virtual_at(0),
        closed_loop,
        pi: None,
        two_lags: false,
    }
}

/// An open-loop record of half a second at 10 Hz, the paper's 1.6 um peak to peak, with 10 um/s of drift.
fn drifting(seed: u64, delay_s: f64) -> Result<Drifting, Failure> {
    let (frequency_hz, drift_um_per_s) = (10.0, 10.0);
    let setup = setup(seed, drift_um_per_s, -10.0, false);
    let sampling = setup.sampling();
    let plan = Plan {
        period_s: sampling.period_s,
        segments: vec![PlannedSegment {
            label: "10 Hz, open loop".to_owned(),
            signal: Signal::Tones {
                tones: vec![Tone {
                    frequency_hz,
                    amplitude_um: 0.8,
                    phase_rad: 0.0,
                }],
                fade_in_s: 0.1,
            },
            lines_hz: vec![frequency_hz],
            detection_hz: vec![],
            settle_s: 0.2,
            measure_s: 0.5,
        }],
        lost_frames: 50,
    };
    let mut bead = HeldBead::open(setup)?;
    let mut records = plan
        .run(&mut bead, 0, |_| {})
        .map_err(|stopped| match stopped.cause {
            Cause::Rig(failure) => failure,
            Cause::BeadLost(error) => Failure::failed(error),
        })?;
    bead.close()?;
    let Some(record) = records.pop() else {
        return Err(Failure::Failed(miette::miette!(
            "the open-loop record at 10 Hz is empty"
        )));
    };
    let rows = record.from..record.input.len();
    let (input, output) = (&record.input[rows.clone()], &record.output[rows]);
    let hold_deg = 180.0 * frequency_hz * sampling.period_s;
    let delay_deg = 360.0 * frequency_hz * delay_s;
    let fft_deg = bare_fft::response(input, output, sampling.period_s, frequency_hz)
        .arg()
        .to_degrees()
        + hold_deg;
    let lines = [frequency_hz];
    let segment = DrivenStretch {
        input,
        output,
        from: 0,
        to: input.len(),
        period_s: sampling.period_s,
        lines_hz: &lines,
        detection_hz: &[],
    };
    let fitted = measure(&segment, &Settings::default()).map_err(Failure::failed)?;
    let fit_deg = fitted.points[0].phase_deg() + hold_deg + delay_deg;
    Ok(Drifting {
        fft_compensated_deg: fft_deg + delay_deg,
        fft_deg,
        fit_deg,
        drift_um_per_s,
        record,
    })
}

fn job(seed: u64) -> Job {
    Job {
        setup: setup(seed, WorldConfig::default().drift_um_per_s, 0.0, true),
        lines_hz: PAPER_FREQUENCIES_HZ.to_vec(),
        excitation: Excitation::Stepped,
        limits: ExcitationLimits {
            bead_um: 8.0,
            bead_um_per_s: 400.0,
            pzt_um: 10.0,
            slew_um_per_s: 3_200.0,
        },
        seconds_at_1_hz: 40.0,
        led_edges: 300,
        bootstrap: 200,
        seed,
        rig: None,
        resume: None,
        keep_in: None,
    }
}

/// What came out, with some of the numbers.
fn sentence(rows: &[row::Row]) -> String {
    let count = |is: &dyn Fn(&row::Row) -> bool| rows.iter().filter(|row| is(row)).count();
    let agree = count(&|row| row.holds && !row.paper_is_wrong && row.identifiable);
    let wrong = count(&|row| row.holds && row.paper_is_wrong);
    let open = count(&|row| row.holds && !row.identifiable);
    let differ = count(&|row| !row.holds);
    let example = |key: &str, name: &str| {
        let row = rows.iter().find(|row| row.key == key)?;
        Some(format!(
            "{name} {} {} here, {} there",
            row.ours_text(),
            row.unit,
            row.paper
        ))
    };
    let said = |examples: [(&str, &str); 2]| {
        let some = examples.iter().filter_map(|(key, name)| example(key, name));
        some.collect::<Vec<_>>().join(", ")
    };
    let mut text = format!(
        "Of {} numbers {agree} agree with the paper ({}). In {wrong} the paper contradicts its own equations or misreads its data ({}). {open} \
         cannot be known from the frequencies that it measured.",
        rows.len(),
        said([("gain_per_s", "gain K"), ("delay", "delay")]),
        said([("lag_5hz", "lag at 5 Hz"), ("eq5", "gain of Eq. (5)")]),
    );
    if differ > 0 {
        text.push_str(&format!(" {differ} differ."));
    }
    text
}

impl Paper {
    /// The page.
    pub fn report(&self) -> Report {
        report(&self.done, &self.drifting, &self.recorded, &self.rows)
    }

    /// Numbers that differ from the paper's although it does not contradict itself.
    pub fn differ(&self) -> usize {
        self.rows.iter().filter(|row| !row.holds).count()
    }

    /// The JSON object.
    pub fn to_json(&self, report: &Path, seed: u64) -> Value {
        row::json(&self.rows, report, seed)
    }

    /// The same for reading.
    pub fn text(&self, report: &Path) -> String {
        row::text(&self.rows, report)
    }
}

fn report(
    done: &Done,
    drifting: &Drifting,
    recorded: &figures::Recorded,
    rows: &[row::Row],
) -> Report {
    let mut report =
        Report::new("Mizoue et al. 2017, Micromachines 8(3):80, from the emulated rig");
    let held = rows.iter().filter(|row| row.holds).count();
    let status = if held == rows.len() {
        Emphasis::Good
    } else {
        Emphasis::Bad
    };
    report.result(status, &sentence(rows));
    report.certainty(&format!(
        "one simulation, whose plant is the paper's Eq. (6): agreement shows that the method of measurement is right and the paper's numbers fit \
         together, not that Eq. (6) is right for a real rig. Agrees: a gain within {} dB, a phase within {} deg, the delay within \
         {} ms, a parameter within its interval; the table has each.",
        row::GAIN_DB,
        row::PHASE_DEG,
        row::DELAY_MS
    ));
    report.figure(plots::bode(
        "fig7-bode",
        "Fig. 7 of the paper from the emulated rig. Left: gain (motion of the bead over that of the piezo) and phase, with the delay of the record \
         taken off and left in. Right: the same less the fit, with 95 % intervals; there Eq. (6), which was simulated, and the fit can be told apart.",
        &done.result,
        plots::Shown { high_hz: 320.0, eq6: true, delayed: true },
    ));
    report.lead(
        "Task: repeat the paper's measurements on the emulated rig (a simulation with Eq. (6) as its plant), and compare every number. Each \
         number comes from rendered frames, through localiser, loop and PZT board; a PI loop held the bead while each line was driven; \
         Fig. A1 is an open-loop record.",
    );
    let mut table = Table::new([
        Column::left("quantity"),
        Column::right("paper"),
        Column::right("here"),
        Column::left("unit"),
        Column::left("verdict"),
        Column::left("remark"),
    ]);
    for row in rows {
        let status = match (row.holds, row.paper_is_wrong) {
            (false, _) => Emphasis::Bad,
            (true, true) => Emphasis::Warning,
            (true, false) => Emphasis::Good,
        };
        table.row_with(
            status,
            [
                row.quantity.clone(),
                row.paper.clone(),
                row.ours_text(),
                row.unit.to_owned(),
                row.verdict().to_owned(),
                row.remark.clone(),
            ],
        );
    }
    report.section("The paper's numbers and ours").table(table);
    report
        .section("Parameters with intervals")
        .table(plots::parameters(&done.result.judged.parameters));
    report
        .section("Fig. 4: input and output at ten frequencies")
        .figure(figures::fig4(done));
    report
        .section("Fig. 5: what a 1 kHz record makes of the drive")
        .figure(figures::fig5a())
        .figure(figures::fig5b(recorded));
    report.section("Fig. 6: delay test");
    if let Some(led) = &done.led {
        report.figure(plots::delay_test("fig6-delay-test", "Light sent by the board and frames as they arrive; the delay that each dithered edge allows.", led));
    }
    report
        .section("Fig. 7: the lines in numbers")
        .table(plots::lines(&done.result, true));
    report.section("Fig. 8: the fit up to 1 kHz").figure(plots::bode(
        "fig8-fit",
        "The fitted model with its 95 % band, continued to 1 kHz; above 300 Hz nothing was measured.",
        &done.result,
        plots::Shown { high_hz: 1000.0, eq6: true, delayed: false },
    ));
    report.table(plots::candidates(&done.result));
    report
        .section("Fig. A1: the complex plane at 10 Hz, with drift")
        .figure(figures::fig_a1(drifting));
    for warning in &done.result.warnings {
        report.note(Emphasis::Warning, warning);
    }
    report
}
