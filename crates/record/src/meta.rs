//! `run.toml`: the conditions of a run, and its end.

use crate::columns::{GROUPS, Group};
use crate::error::RecordError;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::io::Read;
use std::path::Path;

/// A file that went into a run, with its fingerprint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputFile {
    /// Path as given by the user.
    pub path: String,
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256 in lower-case hexadecimal.
    pub sha256: String,
}

impl InputFile {
    /// Fingerprint of a file.
    ///
    /// # Errors
    /// [`RecordError::Io`] when it cannot be read.
    pub fn of(path: &Path) -> Result<Self, RecordError> {
        let attempt = || -> std::io::Result<(u64, String)> {
            let mut file = std::fs::File::open(path)?;
            if !file.metadata()?.is_file() {
                return Err(std::io::Error::other("is not a plain file"));
            }
            let mut block = vec![0; 1 << 16];
            let (mut bytes, mut digest) = (0, Sha256::new());
            loop {
                let read = file.read(&mut block)?;
                if read == 0 {
                    return Ok((bytes, hexadecimal(&digest.finalize())));
                }
                bytes += read as u64;
                digest.update(block.get(..read).unwrap_or_default());
            }
        };
        let (bytes, sha256) = attempt().map_err(RecordError::io("cannot read", path))?;
        Ok(Self {
            path: path.display().to_string(),
            bytes,
            sha256,
        })
    }

    /// Fingerprint of bytes already read.
    pub fn of_bytes(path: &str, bytes: &[u8]) -> Self {
        Self {
            path: path.to_owned(),
            bytes: bytes.len() as u64,
            sha256: hexadecimal(&Sha256::digest(bytes)),
        }
    }
}

fn hexadecimal(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(2 * bytes.len());
    for byte in bytes {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
    }
    text
}

/// The end of a run. It is absent from `run.toml` during the run, and remains absent if the program was killed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunEnd {
    /// Time of the end, UTC. Set by [`crate::RunWriter::finish`].
    #[serde(default)]
    pub ended_utc: String,
    /// The outcome in one or two words: `done`, `interrupted`, `safe`.
    pub outcome: String,
    /// Rows on the disk. Set by [`crate::RunWriter::finish`].
    #[serde(default)]
    pub rows: u64,
    /// Rows that are not on the disk: those lost on the way to the writer. [`crate::RunWriter::finish`] adds those that could not
    /// be written or read back.
    #[serde(default)]
    pub rows_lost: u64,
    /// Events that could not be written. Set by [`crate::RunWriter::finish`].
    #[serde(default)]
    pub events_lost: u64,
    /// Figures of the run, as the command prints them.
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub summary: toml::Table,
}

impl RunEnd {
    /// An end with this outcome and no figures.
    pub fn new(outcome: &str) -> Self {
        Self {
            ended_utc: String::new(),
            outcome: outcome.to_owned(),
            rows: 0,
            rows_lost: 0,
            events_lost: 0,
            summary: toml::Table::new(),
        }
    }
}

/// What `run.toml` holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunMeta {
    /// Version of the folder's layout.
    pub format: u32,
    /// Name of the run, the last part of the folder's name.
    pub name: String,
    /// When it started, UTC. Set by [`crate::RunWriter::create`].
    #[serde(default)]
    pub started_utc: String,
    /// The command line, word by word.
    #[serde(default)]
    pub command_line: Vec<String>,
    /// The folder from which it was started; relative paths of `command_line` and `inputs` start there.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub started_in: String,
    /// Seed of every random number of the run (as text above 2^63).
    #[serde(default, with = "seed", skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// `real` or `virtual`.
    #[serde(default)]
    pub clock: String,
    /// Versions of program and system.
    #[serde(default)]
    pub versions: BTreeMap<String, String>,
    /// The groups of columns in addition to [`Group::Loop`]; all by default.
    #[serde(default = "all_groups")]
    pub columns: Vec<Group>,
    /// Names of the control law's own columns, in the order of [`cellpos_runtime::TickRecord::law`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub law_columns: Vec<String>,
    /// Files that went in.
    #[serde(default)]
    pub inputs: Vec<InputFile>,
    /// Real-time conditions obtained and not obtained, machine, kernel.
    #[serde(default)]
    pub conditions: toml::Table,
    /// The whole configuration used.
    #[serde(default)]
    pub config: toml::Table,
    /// The model in force.
    #[serde(default)]
    pub model: toml::Table,
    /// The controller in force.
    #[serde(default)]
    pub controller: toml::Table,
    /// How it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end: Option<RunEnd>,
}

/// A value deep in a table of run.toml, by the keys on the way to it.
pub(crate) fn value_at<'a>(table: &'a toml::Table, keys: &[&str]) -> Option<&'a toml::Value> {
    let (first, rest) = keys.split_first()?;
    rest.iter()
        .try_fold(table.get(*first)?, |value, key| value.get(*key))
}

/// The same, of a number.
pub fn number_at(table: &toml::Table, keys: &[&str]) -> Option<f64> {
    let value = value_at(table, keys)?;
    value
        .as_float()
        .or_else(|| value.as_integer().map(|whole| whole as f64))
}

fn all_groups() -> Vec<Group> {
    GROUPS.to_vec()
}

impl RunMeta {
    /// Metadata with a name and a clock (`real` or `virtual`), and nothing else yet.
    pub fn new(name: &str, clock: &str) -> Self {
        Self {
            format: crate::FORMAT,
            name: name.to_owned(),
            started_utc: String::new(),
            command_line: Vec::new(),
            started_in: String::new(),
            seed: None,
            clock: clock.to_owned(),
            versions: BTreeMap::new(),
            columns: all_groups(),
            law_columns: Vec::new(),
            inputs: Vec::new(),
            conditions: toml::Table::new(),
            config: toml::Table::new(),
            model: toml::Table::new(),
            controller: toml::Table::new(),
            end: None,
        }
    }

    pub(crate) fn to_toml(&self) -> Result<String, RecordError> {
        toml::to_string(self).map_err(|error| RecordError::Meta(error.to_string()))
    }
}

/// TOML integers are signed: a seed beyond them is written as text.
mod seed {
    use serde::{Deserialize, Deserializer, Serializer};

    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Seed {
        Number(u64),
        Text(String),
    }

    pub(super) fn serialize<S: Serializer>(seed: &Option<u64>, to: S) -> Result<S::Ok, S::Error> {
        match seed {
            None => to.serialize_none(),
            Some(seed) => match i64::try_from(*seed) {
                Ok(number) => to.serialize_i64(number),
                Err(_) => to.serialize_str(&seed.to_string()),
            },
        }
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<u64>, D::Error> {
        match Option::<Seed>::deserialize(from)? {
            None => Ok(None),
            Some(Seed::Number(number)) => Ok(Some(number)),
            Some(Seed::Text(text)) => text.parse().map(Some).map_err(serde::de::Error::custom),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingerprints_are_sha256() {
        let file = InputFile::of_bytes("abc", b"abc");
        assert_eq!(
            file.sha256,
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
        assert_eq!(file.bytes, 3);
    }

    #[test]
    fn metadata_reads_back_with_any_seed() {
        for seed in [None, Some(7), Some(u64::MAX)] {
            let mut meta = RunMeta::new("track", "virtual");
            meta.seed = seed;
            meta.command_line = vec!["cellpos".into(), "track".into()];
            meta.config.insert("kp".into(), toml::Value::Float(0.46));
            meta.inputs.push(InputFile::of_bytes("model.toml", b""));
            meta.end = Some(RunEnd::new("done"));
            let text = meta.to_toml().unwrap();
            assert_eq!(toml::from_str::<RunMeta>(&text).unwrap(), meta, "{text}");
        }
    }
}
