//! Arguments that need more than their type: run folders (a path, or `latest`), quantities above zero, values that begin with
//! a minus.

use cellpos_numeric::units::Seconds;
use clap::builder::{OsStringValueParser, TypedValueParser};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

/// Where runs lie unless an option says otherwise.
const RUNS: &str = "runs";

/// Reads a run folder: a path, `latest` for the newest run below runs/, `latest-NAME` for the newest of that name.
pub(crate) fn run_folder() -> impl TypedValueParser<Value = PathBuf> {
    OsStringValueParser::new().try_map(|text| {
        let path = PathBuf::from(text);
        match path.to_str() {
            Some(word) if !path.exists() && (word == "latest" || word.starts_with("latest-")) => {
                latest(Path::new(RUNS), word.strip_prefix("latest-"))
            }
            _ => Ok(path),
        }
    })
}

/// The newest run folder, of a name if one is given.
fn latest(runs: &Path, name: Option<&str>) -> Result<PathBuf, String> {
    let wanted = |folder: &Path| {
        let text = folder.file_name().and_then(|text| text.to_str())?;
        // <UTC time>-<name>, with -2, -3 ... behind it where a second had more than one.
        let (time, rest) = text.split_once('-')?;
        let (of, number) = match rest.rsplit_once('-') {
            Some((of, tail)) if name.is_none_or(|name| name == of) => {
                (of, tail.parse::<u64>().ok())
            }
            _ => (rest, None),
        };
        let is_run = time.len() == 16
            && time.ends_with('Z')
            && folder.join(cellpos_record::RUN_TOML).exists();
        let named = name.is_none_or(|name| name == rest || (name == of && number.is_some()));
        (is_run && named).then(|| (time.to_owned(), number.unwrap_or(1)))
    };
    let entries = std::fs::read_dir(runs)
        .map_err(|error| match error.kind() {
            std::io::ErrorKind::NotFound => format!(
                "there is no folder {} here: a run makes it; name the run's folder, or change to the folder above it",
                runs.display()
            ),
            _ => format!("{}: {error}", runs.display()),
        })?;
    let folders: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    let newest = (folders.iter())
        .filter_map(|folder| Some((wanted(folder)?, folder)))
        .max();
    let shown = runs.display();
    match (newest, name) {
        (Some((_, folder)), _) => Ok(folder.clone()),
        (None, None) => Err(format!("{shown} holds no run")),
        (None, Some(name)) => Err(format!(
            "{shown} holds no run named {name}{}",
            what_there_is(&folders)
        )),
    }
}

/// The names of the runs that there are, newest first.
fn what_there_is(folders: &[PathBuf]) -> String {
    const MOST: usize = 8;
    let mut names: Vec<&str> = (folders.iter())
        .filter(|folder| folder.join(cellpos_record::RUN_TOML).exists())
        .filter_map(|folder| folder.file_name()?.to_str())
        .collect();
    names.sort_unstable_by(|one, other| other.cmp(one));
    let mut known: Vec<&str> = Vec::new();
    for name in names {
        let Some((_, name)) = name.split_once('-') else {
            continue;
        };
        if !known.contains(&name) {
            known.push(name);
        }
    }
    let more = known.len().saturating_sub(MOST);
    known.truncate(MOST);
    match (known.is_empty(), more) {
        (true, _) => ", and no other".to_string(),
        (false, 0) => format!("; there are {}", known.join(", ")),
        (false, more) => format!("; there are {} and {more} older names", known.join(", ")),
    }
}

/// A time as a program waits it. Longer than thirty years is thirty years: no clock counts on for ever.
pub(crate) fn span(time: Seconds) -> Duration {
    const MOST_S: f64 = 1e9;
    Duration::try_from_secs_f64(time.value().min(MOST_S)).unwrap_or_default()
}

/// Reads the name of a run.
///
/// # Errors
/// Names the characters that a name may have.
pub(crate) fn run_name(text: &str) -> Result<String, String> {
    cellpos_record::check_name(text)
        .map(|()| text.to_owned())
        .map_err(|_| "use letters, digits, `-` and `_`, at most 64 of them".to_owned())
}

/// What is wrong with a whole number, in words for people; None for any other error.
pub(crate) fn about_a_whole_number(
    error: &(dyn std::error::Error + 'static),
    text: &str,
) -> Option<&'static str> {
    use std::num::IntErrorKind::{NegOverflow, PosOverflow, Zero};
    let error = error.downcast_ref::<std::num::ParseIntError>()?;
    Some(match error.kind() {
        Zero => "it must be above zero",
        PosOverflow => "it is too large",
        NegOverflow => "it must not be below zero",
        _ if text.parse::<f64>().is_ok_and(|number| number < 0.0) => "it must not be below zero",
        _ => "write a whole number",
    })
}

/// Reads a quantity that must be above zero, such as a duration.
///
/// # Errors
/// Says what would be right.
pub(crate) fn positive<Q>(text: &str) -> Result<Q, String>
where
    Q: FromStr + PartialOrd + Default,
    Q::Err: std::fmt::Display,
{
    let quantity: Q = text.parse().map_err(|error: Q::Err| error.to_string())?;
    if quantity > Q::default() {
        Ok(quantity)
    } else {
        Err("it must be above zero, for example 10s for a time".to_owned())
    }
}

/// Reads the delay of a loop: a number without a unit probably means milliseconds.
///
/// # Errors
/// Says what would be right.
pub(crate) fn loop_delay(text: &str) -> Result<Seconds, String> {
    let bare = text.trim().parse::<f64>().is_ok_and(f64::is_finite);
    if bare {
        let number = text.trim();
        return Err(format!(
            "a delay needs a unit: write {number}ms for milliseconds (us, ms, s)"
        ));
    }
    positive(text)
}

/// The words of a command line, with each value that begins with a minus and a digit joined to the option in front of it (`--duration
/// -3s`). Otherwise clap takes it for an option, and the message is not about the value.
pub(crate) fn joined(words: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut joined: Vec<OsString> = Vec::new();
    for word in words {
        let negative = word.to_str().is_some_and(|text| {
            let rest = text.strip_prefix('-').unwrap_or("");
            rest.starts_with(|c: char| c.is_ascii_digit() || c == '.')
        });
        let option = joined.last_mut().filter(|before| {
            before
                .to_str()
                .is_some_and(|text| text.len() > 2 && text.starts_with("--") && !text.contains('='))
        });
        match option {
            Some(option) if negative => {
                option.push("=");
                option.push(word);
            }
            _ => joined.push(word),
        }
    }
    joined
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_negative_value_belongs_to_the_option_before_it() {
        let words = [
            "cellpos",
            "track",
            "--duration",
            "-3s",
            "--json",
            "-v",
            "--near=1um",
            "-5",
        ];
        let joined = joined(words.map(OsString::from));
        let expected = [
            "cellpos",
            "track",
            "--duration=-3s",
            "--json",
            "-v",
            "--near=1um",
            "-5",
        ];
        assert_eq!(joined, expected.map(OsString::from));
        assert!(positive::<cellpos_numeric::units::Seconds>("-3s").is_err());
        assert!(
            positive::<cellpos_numeric::units::Seconds>("3")
                .unwrap_err()
                .contains("unit")
        );
        assert!(loop_delay("2.5").unwrap_err().contains("2.5ms"));
        assert_eq!(
            loop_delay("2.5ms"),
            Ok(cellpos_numeric::units::Seconds(0.0025))
        );
        assert!(loop_delay("-1ms").is_err() && loop_delay("ms").is_err());
        assert_eq!(positive("3s"), Ok(cellpos_numeric::units::Seconds(3.0)));
        assert_eq!(span(Seconds(0.5)), Duration::from_millis(500));
        assert_eq!(span(Seconds(1e30)).as_secs(), 1_000_000_000);
    }

    #[test]
    fn the_newest_run_is_found_by_its_time_its_number_and_its_name() {
        let runs = tempfile::tempdir().unwrap();
        for name in [
            "20261121T100000Z-hold",
            "20261121T110000Z-hold",
            "20261121T110000Z-hold-2",
            "20261121T110000Z-hold-10",
            "20261121T120000Z-sine-fast",
            "20261121T130000Z-identify-without-a-run",
        ] {
            let folder = runs.path().join(name);
            std::fs::create_dir(&folder).unwrap();
            if !name.contains("without") {
                std::fs::write(folder.join("run.toml"), "").unwrap();
            }
        }
        let found = |name| {
            let folder = latest(runs.path(), name)?;
            Ok::<_, String>(folder.file_name().unwrap().to_string_lossy().into_owned())
        };
        assert_eq!(found(None).unwrap(), "20261121T120000Z-sine-fast");
        assert_eq!(found(Some("hold")).unwrap(), "20261121T110000Z-hold-10");
        assert_eq!(
            found(Some("sine-fast")).unwrap(),
            "20261121T120000Z-sine-fast"
        );
        let error = found(Some("night")).unwrap_err();
        assert!(
            error.contains("night")
                && error.ends_with("there are sine-fast, hold-2, hold-10, hold"),
            "{error}"
        );
        assert!(latest(Path::new("/nowhere"), None).is_err());
    }
}
