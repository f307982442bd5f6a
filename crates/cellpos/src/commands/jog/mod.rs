//! `cellpos jog`: the PZT moved by hand, within the board's limits, parked at the end.

mod shown;
mod sight;
mod typed;

use crate::outcome::{CommandResult, Failure, Outcome, print_err, print_json, print_text};
use crate::rig_file::{ClockKind, RigFile};
use crate::view_args::PageArgs;
use cellpos_numeric::units::{Micrometers, MicrometersPerSecond};
use cellpos_session::signals;
use cellpos_workbench::Bench;
use cellpos_workbench::mover::Mover;
use cellpos_workbench::snapshot::Seen;
use serde::Serialize;
use shown::{Asked, Shown};
use sight::Sight;
use std::path::PathBuf;
use std::sync::mpsc::Receiver;
use typed::Typed;

/// Arguments of `cellpos jog`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Keys on a terminal, without --to: + and up one step up, - and down one step down, g goes to a displacement (g, 5um, Enter), q ends. From a pipe, lines do the same: `5um`, `+`, `-`, `+2um`, `-2um`, `q`. The PZT is parked at the end, also after Ctrl-C. In open loop the bead flows at some 400 um/s per um from zero flow: small steps keep it in view.\n\n\
    Examples:\n  cellpos jog --rig rig.toml --to 15um --to 20um\n  cellpos jog --rig rig.toml --step 0.5um"
)]
pub(crate) struct Args {
    /// Rig.
    #[arg(long)]
    rig: PathBuf,
    /// Positions to visit before park.
    #[arg(long, value_name = "LENGTH", allow_hyphen_values = true)]
    to: Vec<Micrometers>,
    /// Step of the keys `+` and `-`.
    #[arg(long, default_value = "1um", value_parser = crate::arguments::positive::<Micrometers>)]
    step: Micrometers,
    /// Speed.
    #[arg(long, default_value = "100um/s", value_parser = crate::arguments::positive::<MicrometersPerSecond>)]
    speed: MicrometersPerSecond,
    /// Do not look for a bead.
    #[arg(long)]
    blind: bool,
    #[command(flatten)]
    page: PageArgs,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Where the PZT went, and what was seen there.
#[derive(Debug, Serialize)]
struct Stop {
    commanded_um: f64,
    applied_um: f64,
    /// Position of the bead along the channel, um; without a calibration px.
    bead_um: Option<f64>,
    bead_px: Option<[f64; 2]>,
}

impl Stop {
    fn at(mover: &Mover, seen: Option<Seen>) -> Self {
        Self {
            commanded_um: mover.at_um(),
            applied_um: mover.newest().applied_um,
            bead_um: seen.and_then(|seen| seen.position_um),
            bead_px: seen.map(|seen| [seen.x_px, seen.y_px]),
        }
    }
}

#[derive(Debug, Serialize)]
struct Jogged {
    stops: Vec<Stop>,
    park_um: f64,
}

/// Ticks to rest at a stop before it is looked at.
const SETTLE: u32 = 30;

/// Moves, shows, parks.
pub(crate) fn run(args: Args) -> CommandResult {
    let bench = Bench::of(RigFile::load(Some(&args.rig))?)?;
    let wanted = args.page.wanted(ClockKind::Real)?;
    // Before the board is armed: it does not wait for a camera.
    let mut shown = Shown::open(&wanted, &bench, args.blind)?;
    let mut sight = match &shown {
        None if !args.blind => Sight::of(&bench),
        _ => None,
    };
    let mut mover = Mover::arm(bench.board()?, bench.file())?;
    let mut stops = Vec::new();
    let typed = args.to.is_empty().then(Typed::listen);
    if typed.as_ref().is_some_and(|typed| typed.keyboard.is_some()) {
        print_err(typed::HELP);
    }
    let mut given = args.to.iter();
    let mut at_um = mover.at_um();
    loop {
        let to_um = match &typed {
            None => match given.next() {
                Some(to) => to.0,
                None => break,
            },
            Some(typed) => match next_line(&typed.lines, &mut mover, at_um, &args, &mut shown)? {
                Some(to_um) => to_um,
                None => break,
            },
        };
        if !go(&mut mover, to_um, args.speed.0, &mut shown)? {
            break;
        }
        at_um = to_um;
        let stop = match &mut shown {
            Some(shown) => {
                let seen = shown.look(&mut mover, at_um)?;
                let stop = Stop::at(&mover, seen);
                shown.tell(line(&stop).trim_end());
                stop
            }
            None => {
                let seen = sight.as_mut().map(|sight| sight.look(&mut mover, at_um));
                Stop::at(&mover, seen.transpose()?.flatten())
            }
        };
        if !args.json {
            print_text(&line(&stop))?;
        }
        stops.push(stop);
    }
    let park_um = mover.limits().park_um;
    drop(mover);
    if let Some(shown) = shown {
        shown.over();
    }
    let jogged = Jogged { stops, park_um };
    if args.json {
        print_json(&jogged)?;
    } else {
        print_text(&format!("parking at {park_um} um\n"))?;
    }
    Ok(Outcome::Done)
}

/// Goes there; false when it was asked to stop.
fn go(
    mover: &mut Mover,
    to_um: f64,
    speed_um_per_s: f64,
    shown: &mut Option<Shown>,
) -> Result<bool, Failure> {
    let mut rest = SETTLE;
    while rest > 0 {
        if signals::stopped_by().is_some() {
            return Ok(false);
        }
        let asked = shown.as_ref().map_or(Asked::Nothing, Shown::asked);
        let to_um = match asked {
            Asked::Park => return Ok(false),
            Asked::Freeze => mover.at_um(),
            Asked::Nothing | Asked::To(_) => to_um,
        };
        let there = mover.step(to_um, speed_um_per_s)?;
        if let Some(shown) = shown {
            shown.step(mover);
        }
        if there && asked != Asked::Freeze {
            rest -= 1;
        }
    }
    Ok(true)
}

/// The next displacement to go to; the present one is held meanwhile.
fn next_line(
    lines: &Receiver<String>,
    mover: &mut Mover,
    at_um: f64,
    args: &Args,
    shown: &mut Option<Shown>,
) -> Result<Option<f64>, Failure> {
    use std::sync::mpsc::TryRecvError;
    loop {
        if signals::stopped_by().is_some() {
            return Ok(None);
        }
        mover.step(at_um, args.speed.0)?;
        if let Some(shown) = shown {
            shown.step(mover);
            match shown.asked() {
                Asked::Park => return Ok(None),
                Asked::To(um) => {
                    let limits = mover.limits();
                    return Ok(Some(um.clamp(limits.low_um, limits.high_um)));
                }
                Asked::Freeze | Asked::Nothing => {}
            }
        }
        let text = match lines.try_recv() {
            Ok(text) => text,
            Err(TryRecvError::Empty) => continue,
            Err(TryRecvError::Disconnected) => return Ok(None),
        };
        match (text.trim(), relative(text.trim(), args.step.0)) {
            ("q", _) => return Ok(None),
            ("", _) => {}
            (_, Some(by_um)) => return Ok(Some(at_um + by_um)),
            (text, None) => match text.parse::<Micrometers>() {
                Ok(um) => return Ok(Some(um.0)),
                Err(error) => print_err(&format!("{text}: {error}; or +, -, +2um, -2um, q")),
            },
        }
    }
}

/// How far to go for `+`, `-`, `+2um`, `-2um`.
fn relative(text: &str, step_um: f64) -> Option<f64> {
    let (sign, rest) = match text.strip_prefix('+') {
        Some(rest) => (1.0, rest),
        None => (-1.0, text.strip_prefix('-')?),
    };
    if rest.is_empty() {
        return Some(sign * step_um);
    }
    rest.trim()
        .parse::<Micrometers>()
        .ok()
        .map(|um| sign * um.0)
}

fn line(stop: &Stop) -> String {
    let bead = match (stop.bead_um, stop.bead_px) {
        (Some(um), _) => format!("bead at {um:.2} um"),
        (None, Some([x, y])) => format!("bead at column {x:.1}, row {y:.1}"),
        (None, None) => "no bead seen".to_string(),
    };
    format!(
        "PZT at {:.3} um (commanded {:.3} um), {bead}\n",
        stop.applied_um, stop.commanded_um
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_and_ways_are_read_and_places_are_not_taken_for_them() {
        assert_eq!(relative("+", 0.5), Some(0.5));
        assert_eq!(relative("-", 0.5), Some(-0.5));
        assert_eq!(relative("+2um", 0.5), Some(2.0));
        assert_eq!(relative("-250nm", 0.5), Some(-0.25));
        assert_eq!(relative("5um", 0.5), None);
        assert_eq!(relative("+2", 0.5), None);
    }
}
