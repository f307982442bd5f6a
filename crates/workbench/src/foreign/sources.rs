//! Records to identify: run folders and records of cellpos; other files by their columns.

use super::arrays::read_table;
use super::columns::{self, Wanted};
use cellpos_record::RunReader;
use cellpos_runtime::{Life, TickFlags, TickRecord};
use cellpos_session::Failure;
use cellpos_session::recorded;
use cellpos_session::sessions;
use cellpos_session::setup::{ReferenceSpec, SetupConfig};
use cellpos_table::{ColumnRef, Table};
use std::collections::BTreeMap;
use std::path::Path;

/// A record and its properties.
pub struct Source {
    /// File or folder, and session where a run has several.
    pub name: String,
    /// Rows per second.
    pub rate_hz: f64,
    /// The input, row by row.
    pub input: Vec<f64>,
    /// The output; NaN where none was seen.
    pub output: Vec<f64>,
    /// Reference, if the record has it.
    pub reference: Option<Vec<f64>>,
    /// Whether the record says itself that a loop was closed.
    pub closed: bool,
}

/// Reads a file by its columns if they are stated, else a record of cellpos, or a run folder session by session.
///
/// # Errors
/// A file that cannot be read or is no record, a run without a closed loop, the run of an identification.
pub fn read(path: &Path, stated: Option<&Wanted>) -> Result<Vec<Source>, Failure> {
    if path.is_dir() {
        return runs(path);
    }
    if let Some(wanted) = stated {
        let record = columns::read(path, wanted)?;
        return Ok(vec![Source {
            name: path.display().to_string(),
            rate_hz: 1.0 / record.sample_s,
            input: record.pzt_um,
            output: record.bead_um,
            reference: None,
            closed: false,
        }]);
    }
    own_record(path)
}

fn text_of(path: &Path) -> Result<String, Failure> {
    read_table(path).map_err(|error| {
        Failure::bad_input(
            format!("{}: cannot be read ({error})", path.display()),
            "name a record or a run folder",
        )
    })
}

/// A CSV of cellpos: time_s, pzt_um, bead_um, and perhaps target_um. Where it says when the loop was closed (`life`), as
/// exports of runs do, it is taken as the run would be.
fn own_record(path: &Path) -> Result<Vec<Source>, Failure> {
    let name = path.display().to_string();
    let text = text_of(path)?;
    let foreign = |error: String| {
        Failure::bad_input(
            format!("{name} is not a record of cellpos: {error}"),
            "name the columns of input and output, and the time column or the rate: --input u --output y --rate 1kHz",
        )
    };
    let table = Table::parse(path, &text).map_err(|error| foreign(error.to_string()))?;
    let column = |name: &str, gaps: bool| {
        table
            .numbers(&ColumnRef::Name(name.to_owned()), gaps)
            .map_err(|error| foreign(error.to_string()))
    };
    let (time_s, input, output) = (
        column("time_s", false)?,
        column("pzt_um", false)?,
        column("bead_um", true)?,
    );
    let reference = column("target_um", true).ok();
    if let Some(life) = table.names.iter().position(|name| *name == "life") {
        let whole = |name: &str| column(name, true).unwrap_or_default();
        let (flags, seq, session) = (whole("flags"), whole("seq"), whole("session"));
        let number = |values: &[f64], row: usize| values.get(row).copied().unwrap_or(f64::NAN);
        let rows = table.fields(life).enumerate().map(|(row, life)| {
            let flags = TickFlags(number(&flags, row).max(0.0) as u32);
            let tick = Tick {
                time_ns: (number(&time_s, row) * 1e9).round() as i64,
                seq: number(&seq, row).max(0.0) as u64,
                controlled: life == Life::Running.name() && !flags.has(TickFlags::FREEZE),
                input: number(&input, row),
                output: if is_fresh(flags) {
                    number(&output, row)
                } else {
                    f64::NAN
                },
                reference: reference.as_ref().map_or(f64::NAN, |r| number(r, row)),
            };
            (number(&session, row).max(1.0) as u64, tick)
        });
        let mut sessions: BTreeMap<u64, Vec<Tick>> = BTreeMap::new();
        for (session, tick) in rows {
            sessions.entry(session).or_default().push(tick);
        }
        let many = sessions.len() > 1;
        let sources = sessions
            .iter()
            .filter_map(|(number, ticks)| {
                let name = of_session(&name, many.then_some(*number));
                let all = || Ok(ticks.iter().copied());
                settled(name, reference.is_some(), all).transpose()
            })
            .collect::<Result<Vec<_>, _>>()?;
        return some(sources, path);
    }
    let mut steps: Vec<f64> = time_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    let step_s = steps.get(steps.len() / 2).copied().unwrap_or(0.0);
    if step_s <= 0.0 {
        return Err(foreign("time_s does not rise".to_owned()));
    }
    Ok(vec![Source {
        rate_hz: 1.0 / step_s,
        input,
        output,
        reference,
        closed: false,
        name,
    }])
}

fn of_session(name: &str, number: Option<u64>) -> String {
    number.map_or_else(
        || name.to_owned(),
        |number| format!("{name}, session {number}"),
    )
}

fn some(sources: Vec<Source>, path: &Path) -> Result<Vec<Source>, Failure> {
    if sources.is_empty() {
        return Err(Failure::bad_input(
            format!("{}: the loop was never closed in it", path.display()),
            "name a run in which the bead was held or moved",
        ));
    }
    Ok(sources)
}

/// What is wanted of a tick, from a run folder or from a CSV.
#[derive(Clone, Copy)]
struct Tick {
    time_ns: i64,
    seq: u64,
    controlled: bool,
    input: f64,
    output: f64,
    reference: f64,
}

fn is_fresh(flags: TickFlags) -> bool {
    !flags.has(TickFlags::TIMER) && !flags.has(TickFlags::STALE)
}

impl From<TickRecord> for Tick {
    fn from(tick: TickRecord) -> Self {
        Self {
            time_ns: tick.time_ns,
            seq: tick.seq,
            controlled: tick.is_controlled(),
            input: tick.command_um,
            output: if is_fresh(tick.flags) && tick.verdict == 0 {
                tick.measured_um
            } else {
                f64::NAN
            },
            reference: tick.target_um,
        }
    }
}

/// The ticks of a session from its settled loop to the end by operator or script; None if the loop was never closed. The ticks
/// are asked for twice, so that a night's run needs no night's memory.
fn settled<T: Iterator<Item = Tick>>(
    name: String,
    referenced: bool,
    ticks: impl Fn() -> Result<T, Failure>,
) -> Result<Option<Source>, Failure> {
    const SETTLED_NS: i64 = 2_000_000_000;
    let (mut steps, mut last_ns, mut first_ns) = (Vec::new(), None, None);
    for tick in ticks()? {
        steps.extend(last_ns.replace(tick.time_ns).map(|ns| tick.time_ns - ns));
        first_ns = first_ns.or(tick.controlled.then_some(tick.time_ns));
    }
    let Some(first_ns) = first_ns else {
        return Ok(None);
    };
    let from_ns = first_ns + SETTLED_NS;
    steps.sort_unstable();
    let step_ns = steps
        .get(steps.len() / 2)
        .copied()
        .unwrap_or(1_000_000)
        .max(1);
    let (mut input, mut output, mut reference) = (Vec::new(), Vec::new(), Vec::new());
    let mut last_seq = None;
    for tick in ticks()?.filter(|tick| tick.time_ns >= from_ns) {
        if !tick.controlled {
            break;
        }
        // A tick whose record is lost leaves a row with the command before it, and no position.
        let lost = last_seq.map_or(0, |last: u64| tick.seq.saturating_sub(last + 1).min(10_000));
        for _ in 0..lost {
            input.push(input.last().copied().unwrap_or(tick.input));
            output.push(f64::NAN);
            reference.push(tick.reference);
        }
        last_seq = Some(tick.seq);
        input.push(tick.input);
        output.push(tick.output);
        reference.push(tick.reference);
    }
    Ok(Some(Source {
        name,
        rate_hz: 1e9 / step_ns as f64,
        input,
        output,
        reference: referenced.then_some(reference),
        closed: true,
    }))
}

/// The sessions of a run.
fn runs(path: &Path) -> Result<Vec<Source>, Failure> {
    let folders = sessions::of(path);
    let many = folders.len() > 1;
    let mut sources = Vec::new();
    for (number, folder) in (1u64..).zip(&folders) {
        let reader = RunReader::open(folder).map_err(Failure::input)?;
        let config = recorded::setup(&reader).map(|setup| setup.config);
        if let Ok(SetupConfig {
            reference: ReferenceSpec::Excitation { .. },
            ..
        }) = config
        {
            return Err(Failure::bad_input(
                format!("{} is the run of an identification", path.display()),
                "identify has already written its model and report; to measure again: cellpos identify --rig",
            ));
        }
        let ticks = || {
            let batches = reader.batches().map_err(Failure::input)?;
            Ok(batches.flatten().map(Tick::from))
        };
        let name = of_session(&path.display().to_string(), many.then_some(number));
        sources.extend(settled(name, true, ticks)?);
    }
    some(sources, path)
}
