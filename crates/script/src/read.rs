//! Reading a script file.

use crate::error::ScriptError;
use crate::node::{MAX_S, MAX_UM, Node, Source, cut, length, line_starts, time};
use crate::script::{
    Condition, Load, MoveShape, OnTimeout, Order, Script, Step, StepKind, WaveShape,
};
use crate::shuffle::shuffle;
use cellpos_numeric::units::{Hertz, MicrometersPerSecond};
use cellpos_table::{ColumnRef, Table, read_text};
use std::path::Path;
use toml::de::DeTable;

/// Largest script or waveform, bytes: a hundred times that of any experiment.
pub const MOST_BYTES: u64 = 1 << 26;
/// Most steps that a script may have after its sweeps are written out.
const MAX_STEPS: usize = 100_000;
impl Script {
    /// Reads a script; the files that it names are in its folder.
    ///
    /// # Errors
    /// [`ScriptError`] with the place; a file that cannot be read is an error at line 1.
    pub fn read(path: &Path) -> Result<Self, ScriptError> {
        let file = path.display().to_string();
        let text = read_text(path, MOST_BYTES).map_err(|error| {
            let help = Some("give the path of a script file".to_owned());
            ScriptError::new(&file, "", 0..0, format!("cannot be read: {error}"), help)
        })?;
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        Self::parse_with(&text, &file, &|name| {
            read_text(&folder.join(name), MOST_BYTES).map_err(|error| error.to_string())
        })
    }

    /// Reads a script from text; it cannot name other files. `file` is for messages.
    ///
    /// # Errors
    /// [`ScriptError`] with the place.
    pub fn parse(text: &str, file: &str) -> Result<Self, ScriptError> {
        Self::parse_with(text, file, &|_| {
            Err("files cannot be read from here".to_owned())
        })
    }

    /// Reads a script from text, with the files that it names (waveforms) from `load`.
    ///
    /// # Errors
    /// [`ScriptError`] with the place.
    pub fn parse_with(
        text: &str,
        file: &str,
        load: &dyn Fn(&str) -> Result<String, String>,
    ) -> Result<Self, ScriptError> {
        let lines = line_starts(text);
        let source = Source {
            file,
            text,
            lines: &lines,
        };
        let table = DeTable::parse(text)
            .map_err(|error| source.fail(error.span().unwrap_or(0..0), error.message(), None))?;
        let root = Node {
            source,
            table: table.get_ref(),
            span: (0, 0),
            variables: &[],
        };
        root.only(&[
            "name", "notes", "sample", "start", "seed", "learn", "stop", "clips", "step",
        ])?;
        let name = root.text("name")?.map_or("script", |text| text.value);
        let fits = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if name.is_empty() || name.len() > 64 || !name.chars().all(fits) {
            return Err(source.fail(
                root.span_of("name"),
                format!("`name` = \"{}\" cannot name a run folder", cut(name)),
                Some("use letters, digits, - and _, at most 64"),
            ));
        }
        let mut reader = Reader {
            load,
            seed: root.whole("seed", (0, i64::MAX as u64))?.unwrap_or(0),
            steps: 0,
        };
        let steps = reader.steps(&root, &[])?;
        if steps.is_empty() {
            return Err(source.fail(
                0..0,
                "the script has no steps",
                Some("add for example\n[[step]]\ndo = \"hold\"\nduration = \"1s\""),
            ));
        }
        Ok(Self {
            file: file.to_owned(),
            text: text.to_owned(),
            name: name.to_owned(),
            notes: root.text("notes")?.map_or("", |text| text.value).to_owned(),
            sample: crate::table::sample(&root)?,
            start_um: length(&root, "start", -MAX_UM)?.unwrap_or(0.0),
            learn: root.flag("learn")?.unwrap_or(false),
            stop: crate::table::stop(&root)?,
            clips: crate::table::clips(&root)?,
            steps,
        })
    }
}

/// The context of reading a file.
struct Reader<'l> {
    load: &'l dyn Fn(&str) -> Result<String, String>,
    seed: u64,
    steps: usize,
}

/// Words of `do`.
const KINDS: [(&str, &[&str]); 11] = [
    ("hold", &["duration"]),
    ("move", &["to", "duration", "speed", "shape"]),
    ("sine", WAVE_KEYS),
    ("triangle", WAVE_KEYS),
    ("trapezoid", WAVE_KEYS),
    ("waveform", &["file", "cycles"]),
    ("repeat", &["times", "step"]),
    ("sweep", &["name", "values", "order", "seed", "step"]),
    (
        "wait",
        &[
            "for",
            "within",
            "during",
            "above",
            "below",
            "timeout",
            "on_timeout",
        ],
    ),
    ("mark", &["text"]),
    ("static", &["like", "load"]),
];
const WAVE_KEYS: &[&str] = &["amplitude", "frequency", "cycles", "ramp_in", "ramp_out"];

impl Reader<'_> {
    fn steps(
        &mut self,
        parent: &Node,
        variables: &[(String, String)],
    ) -> Result<Vec<Step>, ScriptError> {
        let mut steps = Vec::new();
        for node in parent.tables("step")? {
            self.steps += 1;
            if self.steps > MAX_STEPS {
                return Err(node.source.fail(
                    node.span(),
                    format!("more than {MAX_STEPS} steps when the sweeps are written out"),
                    Some("use fewer values, or `repeat`"),
                ));
            }
            steps.push(self.step(&Node { variables, ..node }, variables)?);
        }
        Ok(steps)
    }

    fn step(&mut self, node: &Node, variables: &[(String, String)]) -> Result<Step, ScriptError> {
        let words: Vec<(&str, &(&str, &[&str]))> =
            KINDS.iter().map(|kind| (kind.0, kind)).collect();
        let Some((word, keys)) = node.word("do", &words)?.copied() else {
            return Err(node.source.fail(
                node.span(),
                "`do` is missing: what shall the step do?",
                Some("for example do = \"hold\""),
            ));
        };
        let allowed: Vec<&str> = ["do", "label"].iter().chain(keys).copied().collect();
        node.only(&allowed)?;
        let kind = match word {
            "hold" => StepKind::Hold {
                duration_s: need(node, "duration", "for example duration = \"1s\"", time)?,
            },
            "move" => move_step(node)?,
            "sine" => wave(node, WaveShape::Sine)?,
            "triangle" => wave(node, WaveShape::Triangle)?,
            "trapezoid" => wave(node, WaveShape::Trapezoid)?,
            "waveform" => self.waveform(node)?,
            "repeat" => {
                let times = node.whole("times", (1, 100_000_000))?;
                let steps = self.steps(node, variables)?;
                StepKind::Repeat {
                    times: times.ok_or_else(|| {
                        node.source.fail(
                            node.span(),
                            "`times` is missing",
                            Some("for example times = 10"),
                        )
                    })?,
                    steps: self.filled(node, steps)?,
                }
            }
            "sweep" => StepKind::Sweep(self.sweep(node, variables)?),
            "wait" => wait(node)?,
            "mark" => StepKind::Mark {
                text: node
                    .need_text("text", "for example text = \"added drug\"")?
                    .value
                    .to_owned(),
            },
            _ => StepKind::Static {
                like: node
                    .need_text("like", "the label of a step above")?
                    .value
                    .to_owned(),
                load: node
                    .word("load", &[("mean", Load::Mean), ("peak", Load::Peak)])?
                    .unwrap_or_default(),
            },
        };
        let line = node.source.line(node.span().start);
        Ok(Step {
            kind,
            label: node.text("label")?.map(|text| text.value.to_owned()),
            line,
            span: node.span(),
        })
    }

    fn filled(&self, node: &Node, steps: Vec<Step>) -> Result<Vec<Step>, ScriptError> {
        if steps.is_empty() {
            return Err(node.source.fail(
                node.span(),
                "there are no steps inside",
                Some("add [[step.step]] below it"),
            ));
        }
        Ok(steps)
    }

    fn sweep(
        &mut self,
        node: &Node,
        variables: &[(String, String)],
    ) -> Result<Vec<Vec<Step>>, ScriptError> {
        let name = node.need_text("name", "steps inside write \"$name\" for the value")?;
        let mut values = node.texts("values")?;
        if values.is_empty() {
            return Err(node.source.fail(
                node.span_of("values"),
                "`values` is missing or empty",
                Some("for example values = [\"1um\", \"2um\"]"),
            ));
        }
        let orders = [
            ("listed", Order::Listed),
            ("reversed", Order::Reversed),
            ("random", Order::Random),
        ];
        let seed = node
            .whole("seed", (0, i64::MAX as u64))?
            .unwrap_or(self.seed);
        match node.word("order", &orders)?.unwrap_or_default() {
            Order::Listed => {}
            Order::Reversed => values.reverse(),
            Order::Random => shuffle(&mut values, seed),
        }
        let mut all = Vec::new();
        for value in values {
            let mut inner = variables.to_vec();
            inner.push((name.value.to_owned(), value));
            let steps = self.steps(node, &inner)?;
            all.push(self.filled(node, steps)?);
        }
        Ok(all)
    }

    fn waveform(&self, node: &Node) -> Result<StepKind, ScriptError> {
        let file = node.need_text("file", "a CSV file with time_s,position_um")?;
        let fail =
            |message: String, help: &str| node.source.fail(file.span.clone(), message, Some(help));
        let text = (self.load)(file.value).map_err(|error| {
            let help = "the path is taken from the script's folder";
            fail(format!("`{}`: {error}", cut(file.value)), help)
        })?;
        let columns = || -> Result<_, cellpos_table::TableError> {
            let table = Table::parse(Path::new(file.value), &text)?;
            let times = table.numbers(&ColumnRef::Name("time_s".to_owned()), false)?;
            let positions = table.numbers(&ColumnRef::Name("position_um".to_owned()), false)?;
            Ok(times.into_iter().zip(positions).collect::<Vec<_>>())
        };
        let points = columns()
            .map_err(|error| fail(error.to_string(), "the columns are time_s and position_um"))?;
        let rising = points.windows(2).all(|pair| pair[1].0 > pair[0].0);
        let (first, last) = (points.first().copied(), points.last().copied());
        let closed = |a: (f64, f64), b: (f64, f64)| a == (0.0, 0.0) && b.1 == 0.0 && b.0 >= 2e-3;
        if !rising || !matches!((first, last), (Some(a), Some(b)) if closed(a, b)) {
            return Err(fail(
                format!("`{}` is not one closed cycle", cut(file.value)),
                "time must rise from 0 s, and the position start and end at 0 um",
            ));
        }
        if points.iter().any(|(t, x)| *t > MAX_S || x.abs() > MAX_UM) {
            return Err(fail(
                "a point is out of range".to_owned(),
                "is time in s, position in um?",
            ));
        }
        Ok(StepKind::Waveform {
            points,
            cycles: node.whole("cycles", (1, 100_000_000))?.unwrap_or(1),
        })
    }
}

fn need(
    node: &Node,
    key: &str,
    help: &str,
    get: fn(&Node, &str) -> Result<Option<f64>, ScriptError>,
) -> Result<f64, ScriptError> {
    get(node, key)?.ok_or_else(|| {
        node.source
            .fail(node.span(), format!("`{key}` is missing"), Some(help))
    })
}

fn move_step(node: &Node) -> Result<StepKind, ScriptError> {
    let to_um = need(node, "to", "for example to = \"5um\"", |node, key| {
        length(node, key, -MAX_UM)
    })?;
    let duration_s = time(node, "duration")?;
    let speed_um_per_s =
        node.quantity::<MicrometersPerSecond>("speed", MicrometersPerSecond::value, (1e-6, 1e6))?;
    if duration_s.is_some() == speed_um_per_s.is_some() {
        return Err(node.source.fail(
            node.span(),
            "a move needs `duration` or `speed`, and not both",
            Some("for example duration = \"100ms\""),
        ));
    }
    let shapes = [
        ("constant-velocity", MoveShape::ConstantVelocity),
        ("minimum-jerk", MoveShape::MinimumJerk),
        ("s-curve", MoveShape::SCurve),
    ];
    Ok(StepKind::Move {
        to_um,
        duration_s,
        speed_um_per_s,
        shape: node
            .word("shape", &shapes)?
            .unwrap_or(MoveShape::MinimumJerk),
    })
}

fn wave(node: &Node, shape: WaveShape) -> Result<StepKind, ScriptError> {
    let frequency_hz = need(
        node,
        "frequency",
        "for example frequency = \"50Hz\"",
        |node, key| node.quantity::<Hertz>(key, Hertz::value, (1e-5, 400.0)),
    )?;
    let cycles = node.whole("cycles", (1, 100_000_000))?.ok_or_else(|| {
        node.source.fail(
            node.span(),
            "`cycles` is missing",
            Some("for example cycles = 20"),
        )
    })?;
    let ramp_in = node.whole("ramp_in", (0, cycles))?.unwrap_or(0);
    let ramp_out = node.whole("ramp_out", (0, cycles))?.unwrap_or(0);
    if ramp_in + ramp_out > cycles {
        return Err(node.source.fail(
            node.span(),
            format!(
                "ramp_in + ramp_out = {} cycles of {cycles}",
                ramp_in + ramp_out
            ),
            Some("leave cycles at full amplitude between them, or none"),
        ));
    }
    if cycles as f64 / frequency_hz > MAX_S {
        return Err(node.source.fail(
            node.span(),
            "the step lasts longer than thirty days",
            Some("use fewer cycles"),
        ));
    }
    Ok(StepKind::Wave {
        shape,
        amplitude_um: need(
            node,
            "amplitude",
            "for example amplitude = \"5um\"",
            |node, key| length(node, key, 0.0),
        )?,
        frequency_hz,
        cycles,
        ramp_in,
        ramp_out,
    })
}

fn wait(node: &Node) -> Result<StepKind, ScriptError> {
    let timeout_s = time(node, "timeout")?;
    let level = |node: &Node| -> Result<(f64, bool), ScriptError> {
        let above = length(node, "above", -MAX_UM)?;
        match (above, length(node, "below", -MAX_UM)?) {
            (Some(level), None) => Ok((level, true)),
            (None, Some(level)) => Ok((level, false)),
            _ => Err(node.source.fail(
                node.span(),
                "the wait needs `above` or `below`, and not both",
                Some("for example above = \"3um\""),
            )),
        }
    };
    let kinds = [
        ("settled", 0),
        ("position", 1),
        ("cell-length", 2),
        ("time", 3),
    ];
    let condition = match node.word("for", &kinds)? {
        Some(0) => Condition::Settled {
            within_um: length(node, "within", 1e-3)?.unwrap_or(0.1),
            during_s: time(node, "during")?.unwrap_or(0.02),
        },
        Some(1) => {
            let (level_um, above) = level(node)?;
            Condition::Position { level_um, above }
        }
        Some(2) => {
            let (level_um, above) = level(node)?;
            Condition::CellLength { level_um, above }
        }
        Some(_) => {
            let duration_s = need(
                node,
                "during",
                "how long, for example during = \"1s\"",
                time,
            )?;
            return Ok(StepKind::Hold { duration_s });
        }
        None => {
            return Err(node.source.fail(
                node.span(),
                "`for` is missing: what shall the step wait for?",
                Some("for = \"settled\", \"position\", \"cell-length\" or \"time\""),
            ));
        }
    };
    let timeouts = [("stop", OnTimeout::Stop), ("continue", OnTimeout::Continue)];
    Ok(StepKind::Wait {
        condition,
        timeout_s: timeout_s.ok_or_else(|| {
            node.source.fail(
                node.span(),
                "`timeout` is missing: a wait must end",
                Some("for example timeout = \"2s\""),
            )
        })?,
        on_timeout: node.word("on_timeout", &timeouts)?.unwrap_or_default(),
    })
}
