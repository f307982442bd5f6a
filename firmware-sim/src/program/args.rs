//! Command line of `firmware-sim`, and the resulting configuration.

use super::ProgramError;
use cellpos_emulator::BoardConfig;
use cellpos_emulator::{FaultKind, Faults, QUANTITIES, WorldConfig};
use cellpos_numeric::units::{Hertz, Micrometers, Seconds};
use cellpos_plant::Model;
use cellpos_plant::quantities::bare;
use clap::Parser;
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A rig in a box, in real time: the PZT board on a pseudo-terminal, the camera on a Unix socket.
#[derive(Debug, Parser)]
#[command(name = "firmware-sim", version, after_help = EXAMPLE)]
pub(crate) struct Args {
    /// Rig file; only its tables `emulator` and `board` are used
    #[arg(long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    /// Plant and effects: eq6 or a model.toml
    #[arg(long, value_name = "MODEL")]
    pub model: Option<String>,
    /// Random seed
    #[arg(long)]
    pub seed: Option<u64>,
    /// false: the rig has the imperfections of a real one (flow, light, focus and clocks wander)
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub ideal: Option<bool>,
    /// Make a symbolic link to the pseudo-terminal, under a name that stays the same
    #[arg(long, value_name = "PATH")]
    pub pty_link: Option<PathBuf>,
    /// Emulate plant and camera only; a real board is the PZT board. TTY is the terminal on which the board reports its
    /// converter codes (three bytes each, see firmware/README.md). The host talks to the board directly
    #[arg(long, value_name = "TTY", conflicts_with_all = ["pty_link", "link_garbage", "link_loss", "line_stall", "usb_chunks"])]
    pub board: Option<PathBuf>,
    /// Unix socket for the camera's frames [default: firmware-sim-PID.sock in the directory for temporary files]
    #[arg(long, value_name = "PATH")]
    pub socket: Option<PathBuf>,
    /// Write time, applied displacement, true positions and board state as CSV, every millisecond
    #[arg(long, value_name = "FILE")]
    pub log: Option<PathBuf>,
    /// Stop after this time
    #[arg(long, value_name = "TIME")]
    pub duration: Option<Seconds>,
    /// Do not ask for real-time scheduling
    #[arg(long)]
    pub best_effort: bool,
    /// A new bead appears after the old one has been out of the frame for this long
    #[arg(long, value_name = "TIME", default_value = "300ms")]
    pub new_bead_after: Seconds,

    /// Lose frames: a rate (0.01 or 1%) or a time span
    #[arg(long, value_name = "RATE|AT[,FOR]", help_heading = "Faults")]
    pub drop_frames: Vec<RateOrSpan>,
    /// Deliver old buffers under new ids
    #[arg(long, value_name = "RATE|AT[,FOR]", help_heading = "Faults")]
    pub stale_frames: Vec<RateOrSpan>,
    /// Deliver frames twice
    #[arg(long, value_name = "RATE|AT[,FOR]", help_heading = "Faults")]
    pub double_frames: Vec<RateOrSpan>,
    /// Deliver frames after their successors
    #[arg(long, value_name = "RATE|AT[,FOR]", help_heading = "Faults")]
    pub reorder_frames: Vec<RateOrSpan>,
    /// The camera stalls and then delivers in a burst
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub stall_camera: Vec<Span>,
    /// The bead disappears
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub lose_bead: Vec<Span>,
    /// The bead sticks to the wall
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub stick_bead: Vec<Span>,
    /// A second bead appears
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub second_bead: Vec<Span>,
    /// Distance of the second bead from the first
    #[arg(
        long,
        value_name = "LENGTH",
        help_heading = "Faults",
        allow_hyphen_values = true
    )]
    pub second_bead_offset: Option<Micrometers>,
    /// The camera repeats one picture, with new numbers and times
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub frozen_picture: Vec<Span>,
    /// Zero flow steps, as after a tap on the syringe
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub flow_step: Vec<Span>,
    /// Size of that step, as PZT displacement [default: 0.3um]
    #[arg(
        long,
        value_name = "LENGTH",
        help_heading = "Faults",
        allow_hyphen_values = true
    )]
    pub flow_step_size: Option<Micrometers>,
    /// The PZT moves the bead the wrong way
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub gain_flip: Vec<Span>,
    /// The amplifier clips
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub clip_amplifier: Vec<Span>,
    /// Displacement at which the amplifier clips [default: 20.5um]
    #[arg(
        long,
        value_name = "LENGTH",
        help_heading = "Faults",
        allow_hyphen_values = true
    )]
    pub clip_at: Option<Micrometers>,
    /// Bursts of random bytes on the line: at a rate (2Hz), or one every millisecond of a time span
    #[arg(long, value_name = "RATE|AT[,FOR]", help_heading = "Faults")]
    pub link_garbage: Vec<FrequencyOrSpan>,
    /// The line loses every byte
    #[arg(long, value_name = "AT[,FOR]", help_heading = "Faults")]
    pub link_loss: Vec<Span>,
    /// The line stalls and loses nothing: at a time for a duration (5s,100ms), or at a mean rate for up to a duration
    /// (0.5Hz,180ms)
    #[arg(long, value_name = "AT,FOR|RATE,LONGEST", help_heading = "Faults")]
    pub line_stall: Vec<StallOption>,
    /// Bytes pass the line in packets of at most this size, one each way every 125 us
    #[arg(long, value_name = "BYTES", help_heading = "Faults", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub usb_chunks: Option<u16>,
}

const EXAMPLE: &str = "\
Times count from the start of the program; without FOR a fault stays. A fault may be given more than once.

Example: a rig whose camera loses 1 % of its frames and whose bead is gone for half a second
  firmware-sim --pty-link pzt --socket camera.sock --log box.csv --drop-frames 1% --lose-bead 5s,500ms
and in another terminal a rig.toml that names `pzt` and `camera.sock`:
  cellpos track --rig rig.toml --target 0um";

/// Start and duration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Span {
    /// Start.
    pub at: Seconds,
    /// Duration; `None`: for good.
    pub length: Option<Seconds>,
}

impl FromStr for Span {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let time = |text: &str| text.parse::<Seconds>().map_err(|error| error.to_string());
        let (at, length) = match text.split_once(',') {
            Some((at, length)) => (time(at)?, Some(time(length)?)),
            None => (time(text)?, None),
        };
        if at.value() < 0.0 || length.is_some_and(|length| length.value() <= 0.0) {
            return Err("a fault starts at 0s or later and lasts for more than 0s".to_owned());
        }
        Ok(Self { at, length })
    }
}

/// A probability per frame, or a time span in which every frame is hit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum RateOrSpan {
    /// Probability.
    Rate(f64),
    /// Every frame.
    Span(Span),
}

impl FromStr for RateOrSpan {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let rate = match text.strip_suffix('%') {
            Some(percent) => percent.trim().parse::<f64>().map(|percent| percent / 100.0),
            None => text.parse::<f64>(),
        };
        match rate {
            Ok(rate) if (0.0..=1.0).contains(&rate) => Ok(Self::Rate(rate)),
            Ok(_) => Err(format!(
                "a rate is a probability from 0 to 1: write for example 0.01 or 1%; \
                 a time needs a unit, for example {text}s"
            )),
            Err(_) => text.parse().map(Self::Span),
        }
    }
}

/// A stall at a time, or stalls at random.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum StallOption {
    /// From a time on.
    Span(Span),
    /// Now and then.
    Random {
        /// Mean number of stalls a second.
        rate: Hertz,
        /// Longest; the shortest is a millisecond.
        longest: Seconds,
    },
}

impl FromStr for StallOption {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let (first, length) = text.split_once(',').ok_or_else(|| {
            "a stall has two parts: a time and a length (5s,100ms), or a rate and a longest length (0.5Hz,180ms)".to_owned()
        })?;
        let Ok(rate) = first.parse::<Hertz>() else {
            return text.parse().map(Self::Span);
        };
        let longest: Seconds = length.parse().map_err(|error| format!("{error}"))?;
        if rate.value() <= 0.0 || longest.value() < 1e-3 {
            return Err("stalls come at more than 0Hz and last for 1ms or more".to_owned());
        }
        Ok(Self::Random { rate, longest })
    }
}

/// Bursts per second, or a time span.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum FrequencyOrSpan {
    /// Mean number of bursts a second.
    Frequency(Hertz),
    /// One burst each millisecond.
    Span(Span),
}

impl FromStr for FrequencyOrSpan {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text.parse::<Hertz>() {
            Ok(frequency) => Ok(Self::Frequency(frequency)),
            Err(_) => text
                .parse()
                .map(Self::Span)
                .map_err(|error: String| format!("{error}; or a frequency, for example 2Hz")),
        }
    }
}

/// Parts of the box.
#[derive(Debug)]
pub(crate) struct Setup {
    /// World.
    pub world: WorldConfig,
    /// Board.
    pub board: BoardConfig,
    /// Plant and effects.
    pub model: Model,
}

/// The tables of a rig file that concern the box.
#[derive(Debug, Default, Deserialize)]
struct RigFile {
    #[serde(default)]
    emulator: WorldConfig,
    #[serde(default)]
    board: BoardConfig,
}

impl Args {
    /// Reads the named files; the command line overrides them.
    ///
    /// # Errors
    /// Files that cannot be read or parsed.
    pub(crate) fn setup(&self) -> Result<Setup, ProgramError> {
        let mut file = match &self.rig {
            Some(path) => read_rig_file(path)?,
            None => RigFile::default(),
        };
        if let Some(seed) = self.seed {
            file.emulator.seed = seed;
        }
        file.emulator.ideal = self.ideal.unwrap_or(file.emulator.ideal);
        if let Some(model) = &self.model {
            file.emulator.model.clone_from(model);
        } else if let Some(beside) = self.rig.as_deref().and_then(Path::parent) {
            // A path in the rig file starts at the rig file's folder.
            let path = beside.join(&file.emulator.model);
            if path.is_file() {
                file.emulator.model = path.display().to_string();
            }
        }
        let new_bead_ms = self.new_bead_after.value() * 1e3;
        file.emulator.new_bead_after_ms.get_or_insert(new_bead_ms);
        self.add_faults(&mut file.emulator.faults);
        let model = Model::load(&file.emulator.model)
            .map_err(|error| ProgramError::Model(error.to_string()))?;
        Ok(Setup {
            world: file.emulator,
            board: file.board,
            model,
        })
    }

    fn add_faults(&self, faults: &mut Faults) {
        let mut spans: Vec<(FaultKind, Span)> = Vec::new();
        for (given, kind) in [
            (&self.stall_camera, FaultKind::StallCamera),
            (&self.lose_bead, FaultKind::LoseBead),
            (&self.stick_bead, FaultKind::StickBead),
            (&self.second_bead, FaultKind::SecondBead),
            (&self.link_loss, FaultKind::LinkLoss),
            (&self.frozen_picture, FaultKind::FrozenPicture),
            (&self.flow_step, FaultKind::FlowStep),
            (&self.gain_flip, FaultKind::GainFlip),
            (&self.clip_amplifier, FaultKind::ClipAmplifier),
        ] {
            spans.extend(given.iter().map(|&span| (kind, span)));
        }
        for (given, kind, rate) in [
            (
                &self.drop_frames,
                FaultKind::DropFrames,
                &mut faults.drop_rate,
            ),
            (
                &self.stale_frames,
                FaultKind::StaleFrames,
                &mut faults.stale_rate,
            ),
            (
                &self.double_frames,
                FaultKind::DoubleFrames,
                &mut faults.double_rate,
            ),
            (
                &self.reorder_frames,
                FaultKind::ReorderFrames,
                &mut faults.reorder_rate,
            ),
        ] {
            for item in given {
                match *item {
                    RateOrSpan::Rate(value) => *rate = value,
                    RateOrSpan::Span(span) => spans.push((kind, span)),
                }
            }
        }
        for item in &self.link_garbage {
            match *item {
                FrequencyOrSpan::Frequency(frequency) => faults.garbage_per_s = frequency.value(),
                FrequencyOrSpan::Span(span) => spans.push((FaultKind::LinkGarbage, span)),
            }
        }
        if let Some(offset) = self.second_bead_offset {
            faults.second_bead_um = offset.value();
        }
        if let Some(size) = self.flow_step_size {
            faults.flow_step_um = size.value();
        }
        if let Some(most) = self.clip_at {
            faults.clip_um = most.value();
        }
        for (kind, span) in spans {
            let (at_s, for_s) = (span.at.value(), span.length.map(Seconds::value));
            faults
                .event
                .push(cellpos_emulator::FaultEvent { kind, at_s, for_s });
        }
    }
}

fn read_rig_file(path: &Path) -> Result<RigFile, ProgramError> {
    let text = std::fs::read_to_string(path).map_err(|source| ProgramError::File {
        path: path.to_owned(),
        doing: "reading the rig file",
        source,
    })?;
    let refused = |problem: String| ProgramError::RigFile {
        path: path.to_owned(),
        problem,
    };
    let text = bare(&text, &QUANTITIES)
        .map_err(|error| refused(format!("line {}: {error}", error.line)))?;
    toml::from_str(&text).map_err(|error| refused(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<Args, clap::Error> {
        Args::try_parse_from(std::iter::once("firmware-sim").chain(line.split_whitespace()))
    }

    #[test]
    fn faults_of_the_command_line_reach_the_world() {
        let line = "--drop-frames 1% --stale-frames 0.02 --double-frames 2s,10ms --lose-bead 5s,500ms \
                    --lose-bead 9s --link-garbage 3Hz --link-loss 1.5s --second-bead-offset -2um --seed 9 \
                    --flow-step 3s,1s --flow-step-size -0.5um --gain-flip 4s --frozen-picture 7s,3s --clip-amplifier 8s \
                    --clip-at 21um";
        let world = parse(line).unwrap().setup().unwrap().world;
        let faults = &world.faults;
        assert_eq!(world.seed, 9);
        let ideal = |line: &str| parse(line).unwrap().setup().unwrap().world.ideal;
        assert!(ideal("--ideal") && !ideal("--ideal=false"));
        assert_eq!(
            (faults.drop_rate, faults.stale_rate, faults.double_rate),
            (0.01, 0.02, 0.0)
        );
        assert_eq!((faults.garbage_per_s, faults.second_bead_um), (3.0, -2.0));
        let ns = |s: f64| (s * 1e9) as i64;
        assert!(faults.active(FaultKind::DoubleFrames, ns(2.005)));
        assert!(!faults.active(FaultKind::DoubleFrames, ns(2.011)));
        assert!(!faults.active(FaultKind::LoseBead, ns(5.6)));
        assert!(faults.active(FaultKind::LoseBead, ns(1e6)));
        assert!(faults.active(FaultKind::LinkLoss, ns(1.5)));
        assert_eq!((faults.flow_step_um, faults.clip_um), (-0.5, 21.0));
        for (kind, at_s) in [
            (FaultKind::FlowStep, 3.5),
            (FaultKind::GainFlip, 4.1),
            (FaultKind::FrozenPicture, 7.1),
            (FaultKind::ClipAmplifier, 8.1),
        ] {
            assert!(faults.active(kind, ns(at_s)), "{kind:?}");
            assert!(!faults.active(kind, ns(2.9)), "{kind:?}");
        }
    }

    #[test]
    fn a_rig_file_may_have_quantities_with_units_and_a_wrong_one_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        let of = |text: &str| {
            std::fs::write(&path, text).unwrap();
            parse(&format!("--rig {}", path.display())).unwrap().setup()
        };
        let setup = of(
            "[limits]\npark = \"1um\"\n[board]\npower_up = \"10um\"\nwatchdog = \"0.05s\"\n[emulator]\nneutral = \"0.01mm\"\n\
             new_bead_after = \"1s\"\n[[emulator.faults.event]]\nkind = \"lose-bead\"\nat = \"2s\"\n",
        )
        .unwrap();
        assert_eq!(
            (setup.board.power_up_um, setup.board.watchdog_ms),
            (10.0, 50)
        );
        assert_eq!(
            (setup.world.neutral_um, setup.world.new_bead_after_ms),
            (10.0, Some(1000.0))
        );
        assert_eq!(setup.world.faults.event[0].at_s, 2.0);
        let error = of("[board]\npark = \"20ms\"\n").unwrap_err().to_string();
        assert!(
            error.contains("line 2") && error.contains("park"),
            "{error}"
        );
    }

    #[test]
    fn times_without_a_unit_and_rates_beyond_one_are_refused_with_what_to_write() {
        for (line, hint) in [
            ("--lose-bead 5", "5s"),
            ("--drop-frames 5", "1%"),
            ("--link-garbage 5", "2Hz"),
            ("--lose-bead 5s,0s", "more than 0s"),
            ("--duration 10", "10s"),
            ("--line-stall 5s", "5s,100ms"),
            ("--line-stall 0Hz,10ms", "more than 0Hz"),
            ("--usb-chunks 0", "1..=4096"),
        ] {
            let error = parse(line).unwrap_err().to_string();
            assert!(error.contains(hint), "{line}: {error}");
        }
    }

    #[test]
    fn the_help_shows_an_example() {
        let help = parse("--help").unwrap_err().to_string();
        assert!(help.contains("firmware-sim --pty-link"));
    }
}
