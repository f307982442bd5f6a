//! `cellpos simulate`: the noise-free response of a model to the commands of a record.

use crate::commands::identify::HoldKind;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use cellpos_ident::base::Grid;
use cellpos_ident::sampled::Hold;
use cellpos_plant::{Hertz, Model, SimulateOptions, simulate};
use cellpos_record::{RunReader, SESSIONS};
use cellpos_session::sessions;
use cellpos_table::{Mapping, Record, csv_field};
use cellpos_workbench::foreign::base;
use cellpos_workbench::foreign::columns::{self, Wanted};
use std::path::PathBuf;

/// Arguments of `cellpos simulate`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  cellpos simulate --model eq6 --input in.csv --out out.csv\n  \
                        cellpos simulate --model base.toml --input d.csv --input-column 'power [W]' --output-column 'T [degC]' --out s.csv\n\n\
                        The input needs the columns time_s and pzt_um; the output has time_s, pzt_um and bead_um, the position just before the row's command takes effect. The bead starts at rest at 0 um. With --input-column (another rig, a model of identify --data or reconcile --base) the plant starts at rest at the model's working point, and its output counts from the mean of the identified records."
)]
pub(crate) struct Args {
    /// `eq6`, or a model file.
    #[arg(long)]
    model: String,
    /// A record (text, .npy, .mat), or a run folder.
    #[arg(long, value_parser = crate::arguments::run_folder())]
    input: PathBuf,
    /// The record to write.
    #[arg(long)]
    out: PathBuf,
    /// Input column of another rig's record: its name, or its number from 1.
    #[arg(long)]
    input_column: Option<String>,
    /// Name of the output column in the written record [default: output].
    #[arg(long, requires = "input_column")]
    output_column: Option<String>,
    /// Time column, in the unit of its name, else in seconds [default: the one called time or t].
    #[arg(long, requires = "input_column")]
    time_column: Option<String>,
    /// Sampling rate of a record without a time column.
    #[arg(long, requires = "input_column", value_parser = crate::arguments::positive::<cellpos_numeric::units::Hertz>)]
    rate: Option<cellpos_numeric::units::Hertz>,
    /// Input between rows [default: as the model was identified, else zero-order].
    #[arg(long, value_enum)]
    hold: Option<HoldKind>,
    /// Add Brownian motion and localisation noise from this seed.
    #[arg(long)]
    seed: Option<u64>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Reads, simulates, writes.
pub(crate) fn run(args: Args) -> CommandResult {
    output::ready([&args.out])?;
    let model = Model::load(&args.model).map_err(Failure::input)?;
    let input = if args.input.is_dir() {
        let sessions = sessions::of(&args.input).len();
        if sessions > 1 {
            // Each begins with another bead.
            tracing::warn!(
                "{} has {sessions} sessions: the first is simulated; name the folder of another one, below {}",
                args.input.display(),
                args.input.join(SESSIONS).display()
            );
        }
        RunReader::open(&args.input)
            .and_then(|run| run.to_record())
            .map_err(Failure::input)?
    } else {
        match &args.input_column {
            Some(column) => foreign(&args, column)?,
            None => Record::read(&args.input, &Mapping::commands_only()).map_err(Failure::input)?,
        }
    };
    let options = SimulateOptions {
        seed: args.seed,
        ..SimulateOptions::default()
    };
    let held = match args.hold {
        Some(hold) => hold == HoldKind::ZeroOrder,
        None => model
            .provenance
            .get(base::HOLD)
            .is_none_or(|hold| hold != "none"),
    };
    if let Some(warning) = away_from_rest(&model, &input) {
        tracing::warn!("{warning}");
    }
    let bead_um = response(&model, &input.pzt_um, input.step_s, held, &options)?;
    let mut answer = Record::new(&input.name, input.step_s, input.pzt_um, bead_um);
    answer.start_s = input.start_s;
    match &args.input_column {
        Some(column) => {
            let output = args.output_column.as_deref().unwrap_or("output");
            write_named(&args, &model, &answer, [column, output])?;
        }
        None => answer.write(&args.out).map_err(Failure::failed)?,
    }
    if args.json {
        print_json(&serde_json::json!({
            "out": args.out,
            "rows": answer.len(),
            "rate_hz": answer.rate_hz(),
        }))?;
    } else {
        print_text(&format!("{}: {} rows\n", args.out.display(), answer.len()))?;
    }
    Ok(Outcome::Done)
}

/// What is said of commands that never come to the displacement at which the model's bead rests: it then goes one way only.
fn away_from_rest(model: &Model, input: &Record) -> Option<String> {
    let of_other_data = model.provenance.contains_key(base::HOLD);
    let (low_um, high_um) = (input.pzt_um.iter())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), u| {
            (a.min(*u), b.max(*u))
        });
    let rest_um = model.working_point_um;
    if of_other_data || !(high_um < rest_um || low_um > rest_um) {
        return None;
    }
    // A plant that does not integrate comes to rest anywhere: its speed falls with the frequency.
    let [slow, usual] = [0.02, 2.0].map(|hz| model.plant.velocity_gain_at(Hertz(hz)));
    let mean_um = input.pzt_um.iter().sum::<f64>() / input.len() as f64;
    let travel_um = usual * (mean_um - rest_um) * input.len() as f64 * input.step_s;
    (slow > 0.3 * usual && travel_um.abs() > 1.0).then(|| format!(
        "the command goes from {low_um} to {high_um} um, but the model's bead rests at {rest_um} um: it travels about {travel_um:.0} um; check the unit of the column, or working_point_um in the model"
    ))
}

/// The input of another rig's record.
fn foreign(args: &Args, column: &str) -> Result<Record, Failure> {
    let read = columns::read(
        &args.input,
        &Wanted {
            input: column,
            output: None,
            time: args.time_column.as_deref(),
            rate: args.rate,
            factors: [1.0, 1.0],
            rows: None,
            held: args.hold != Some(HoldKind::None),
        },
    )?;
    let mut record = Record::new(&read.name, read.sample_s, read.pzt_um, read.bead_um);
    record.start_s = read.start_s;
    Ok(record)
}

/// The response of a model to an input that is held between rows, or not.
///
/// # Errors
/// What cannot be simulated.
pub(super) fn response(
    model: &Model,
    input: &[f64],
    step_s: f64,
    held: bool,
    options: &SimulateOptions,
) -> Result<Vec<f64>, Failure> {
    match held {
        true => simulate(model, input, step_s, options).map_err(Failure::input),
        false => between_rows(model, input, step_s, options),
    }
}

/// The response to an input that is sampled and not held: on a grid four times as fine, as `reconcile` has it.
fn between_rows(
    model: &Model,
    input: &[f64],
    step_s: f64,
    options: &SimulateOptions,
) -> Result<Vec<f64>, Failure> {
    let direct = model.plant.relative_degree() == 0;
    let grid = Grid::new(input, Hold::None, direct);
    let step_s = step_s / grid.steps as f64;
    // A direct path shows the value at the end of the step before: the row's own.
    let first = grid.held.first().copied();
    let fine: Vec<f64> = match direct {
        true => first.into_iter().chain(grid.held.iter().copied()).collect(),
        false => grid.held,
    };
    let fine_um = simulate(model, &fine, step_s, options).map_err(Failure::input)?;
    let skip = usize::from(direct);
    Ok((fine_um.into_iter().skip(skip).step_by(grid.steps))
        .take(input.len())
        .collect())
}

/// Writes the columns under the names that the user has for them.
fn write_named(
    args: &Args,
    model: &Model,
    answer: &Record,
    names: [&str; 2],
) -> Result<(), Failure> {
    use std::fmt::Write as _;
    let rest: f64 = (model.provenance.get(base::REST_OUTPUT))
        .and_then(|text| text.parse().ok())
        .unwrap_or(0.0);
    // A column given by number has no name.
    let input = names[0].parse::<usize>().map_or(names[0], |_| "input");
    let mut text = format!("time_s,{},{}\n", csv_field(input), csv_field(names[1]));
    for (k, (u, y)) in answer.pzt_um.iter().zip(&answer.bead_um).enumerate() {
        let t = answer.start_s + k as f64 * answer.step_s;
        // Writing into a String cannot fail.
        let _ = writeln!(text, "{t:.9},{u},{}", y + rest);
    }
    output::write(&args.out, &text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_plant::TransferFunction;

    #[test]
    fn commands_that_never_come_to_the_working_point_are_warned_of_where_the_bead_then_leaves() {
        let at = |um: f64| Record::new("r", 1e-3, vec![um, um + 1.0, um, um + 1.0], Vec::new());
        let away = away_from_rest(&Model::eq6(), &at(20.0));
        assert!(away.is_some_and(|w| w.contains("rests at 4 um")));
        assert_eq!(away_from_rest(&Model::eq6(), &at(3.5)), None);
        let still = TransferFunction::new(vec![2.0], vec![1.0]).map(|plant| Model {
            plant,
            ..Model::eq6()
        });
        assert_eq!(away_from_rest(&still.unwrap(), &at(20.0)), None);
    }
}
