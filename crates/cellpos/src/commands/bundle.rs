//! `cellpos bundle`: a run, packed for archiving, with a manifest that any SHA-256 tool checks.

use super::beside;
use crate::arguments::run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_record::{InputFile, RunReader};
use cellpos_table::read_text;
use std::path::{Component, Path, PathBuf};

/// Name of the manifest.
const MANIFEST: &str = "MANIFEST.sha256";
/// Folder of the files that went into the run.
const INPUTS: &str = "inputs";

/// Arguments of `cellpos bundle`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos bundle runs/20261121T190000Z-fatigue
  cellpos bundle --verify runs/20261121T190000Z-fatigue-bundle

A bundle is a plain folder: the run with all sessions, its unchanged input files, and MANIFEST.sha256, which sha256sum -c reads, too.
Exit code 1: a bundle differs from its manifest.")]
pub(crate) struct Args {
    /// The run's folder.
    #[arg(required_unless_present = "verify", conflicts_with = "verify", value_parser = run_folder())]
    run: Option<PathBuf>,
    /// New folder; default: that of the run with -bundle appended.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Check a bundle against its manifest.
    #[arg(long, value_name = "BUNDLE")]
    verify: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Packs or checks.
pub(crate) fn run(args: Args) -> CommandResult {
    match (&args.run, &args.verify) {
        (_, Some(bundle)) => verify(bundle, args.json),
        (Some(run), None) => pack(run, args.out.as_deref(), args.json),
        (None, None) => Err(Failure::bad_input("nothing to pack", "give a run folder")),
    }
}

fn io(what: &str, path: &Path) -> impl FnOnce(std::io::Error) -> Failure {
    let message = format!("{what} {}", path.display());
    move |error| Failure::Failed(miette::miette!("{message}: {error}"))
}

/// Depth limit of folders in a run, against links that lead back up.
const DEEPEST: usize = 16;

/// What is done about symbolic links.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Links {
    /// Their targets are copied.
    Followed,
    /// They are refused.
    Refused,
}

/// Whether a name is that of a file under way, which a program that was killed left behind: it is nobody's data.
fn is_half_made(name: &std::ffi::OsStr) -> bool {
    let name = name.as_encoded_bytes();
    name.starts_with(b".") && name.ends_with(b".part")
}

/// Files below a folder, in order, as paths from it.
fn files(folder: &Path, links: Links) -> Result<Vec<PathBuf>, Failure> {
    let mut found = Vec::new();
    let mut open = vec![PathBuf::new()];
    while let Some(below) = open.pop() {
        let here = folder.join(&below);
        for entry in std::fs::read_dir(&here).map_err(io("cannot read", &here))? {
            let entry = entry.map_err(io("cannot read", &here))?;
            if links == Links::Followed && is_half_made(&entry.file_name()) {
                continue;
            }
            let path = below.join(entry.file_name());
            let full = folder.join(&path);
            let mut kind = entry.file_type().map_err(io("cannot read", &full))?;
            if kind.is_symlink() && links == Links::Followed {
                kind = std::fs::metadata(&full)
                    .map_err(io("cannot follow the symbolic link", &full))?
                    .file_type();
            }
            let plain = path
                .to_str()
                .is_some_and(|name| !name.contains(char::is_control));
            if !plain {
                return Err(Failure::bad_input(
                    format!("{full:?}: a name that a manifest cannot hold"),
                    "rename the file: letters, digits and the usual signs",
                ));
            }
            if kind.is_file() {
                found.push(path);
            } else if kind.is_dir() && path.components().count() <= DEEPEST {
                open.push(path);
            } else {
                return Err(Failure::bad_input(
                    format!("{}: neither a file nor a folder", full.display()),
                    "a bundle holds files; move it elsewhere",
                ));
            }
        }
    }
    found.sort();
    Ok(found)
}

/// Copies a file into a bundle, block by block.
fn copy(from: &Path, to: &Path) -> Result<(), Failure> {
    if let Some(folder) = to.parent() {
        std::fs::create_dir_all(folder).map_err(io("cannot create", folder))?;
    }
    std::fs::copy(from, to)
        .map(|_| ())
        .map_err(io("cannot copy", from))
}

fn pack(run: &Path, out: Option<&Path>, json: bool) -> CommandResult {
    let reader = RunReader::open(run).map_err(Failure::input)?;
    let out = out.map_or_else(|| beside(run, "-bundle"), Path::to_owned);
    if out.exists() {
        return Err(Failure::bad_input(
            format!("{} is there already", out.display()),
            "a bundle is never overwritten: give another --out",
        ));
    }
    // Made under a temporary name first, so that a folder of the final name is complete.
    let mut name = std::ffi::OsString::from(".");
    name.push(out.file_name().unwrap_or_default());
    name.push(format!(".{}.part", std::process::id()));
    let part = out.with_file_name(name);
    if let Some(folder) = out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|error| {
            Failure::bad_input(
                format!("{}: cannot be made: {error}", folder.display()),
                "name a folder in one that you may write to",
            )
        })?;
    }
    std::fs::create_dir(&part).map_err(|error| {
        Failure::bad_input(
            format!("{}: cannot be made: {error}", out.display()),
            "name a folder in one that you may write to",
        )
    })?;
    let packed = fill(run, &reader, &part).and_then(|packed| {
        std::fs::rename(&part, &out).map_err(io("cannot make", &out))?;
        Ok(packed)
    });
    let packed = packed.inspect_err(|_| {
        let _ = std::fs::remove_dir_all(&part);
    })?;
    if json {
        print_json(&serde_json::json!({
            "bundle": out, "files": packed.files, "bytes": packed.bytes, "inputs_missing": packed.missing,
        }))?;
    } else {
        print_text(&format!(
            "{}: {} files, {} bytes\n",
            out.display(),
            packed.files,
            packed.bytes
        ))?;
        for path in packed.missing {
            print_text(&format!(
                "not packed, gone or changed since the run: {path}\n"
            ))?;
        }
    }
    Ok(Outcome::Done)
}

/// What a bundle holds.
struct Packed {
    files: usize,
    bytes: u64,
    /// Inputs that are gone or changed.
    missing: Vec<String>,
}

fn fill(run: &Path, reader: &RunReader, part: &Path) -> Result<Packed, Failure> {
    for path in files(run, Links::Followed)? {
        copy(&run.join(&path), &part.join(&path))?;
    }
    let mut missing = Vec::new();
    let meta = reader.meta().ok();
    let inputs = meta.map_or(&[][..], |meta| &meta.inputs);
    let from = meta.map_or(Path::new(""), |meta| Path::new(&meta.started_in));
    for (number, input) in inputs.iter().enumerate() {
        let path = &from.join(&input.path);
        let same = InputFile::of(path).is_ok_and(|now| now.sha256 == input.sha256);
        if same && let Some(name) = path.file_name() {
            let name = format!("{number:02}-{}", name.to_string_lossy());
            copy(path, &part.join(INPUTS).join(name))?;
        } else {
            missing.push(input.path.clone());
        }
    }
    let mut manifest = String::new();
    let mut bytes = 0;
    let packed = files(part, Links::Refused)?;
    for path in &packed {
        let file = InputFile::of(&part.join(path)).map_err(Failure::failed)?;
        bytes += file.bytes;
        manifest.push_str(&format!("{}  {}\n", file.sha256, path.display()));
    }
    let path = part.join(MANIFEST);
    std::fs::write(&path, manifest).map_err(io("cannot write", &path))?;
    Ok(Packed {
        files: packed.len(),
        bytes,
        missing,
    })
}

/// Whether a name in a manifest stays in the bundle.
fn stays_inside(name: &Path) -> bool {
    let mut parts = name.components();
    parts.clone().next().is_some() && parts.all(|part| matches!(part, Component::Normal(_)))
}

fn verify(bundle: &Path, json: bool) -> CommandResult {
    let path = bundle.join(MANIFEST);
    const MOST_MANIFEST: u64 = 1 << 26;
    let manifest = read_text(&path, MOST_MANIFEST).map_err(|error| {
        Failure::bad_input(
            format!("{}: {error}", path.display()),
            "give the folder of a bundle",
        )
    })?;
    let mut listed = Vec::new();
    let mut wrong = Vec::new();
    for line in manifest.lines() {
        let Some((sha256, name)) = line.split_once("  ") else {
            wrong.push(format!("manifest: {line}"));
            continue;
        };
        let full = bundle.join(name);
        if !stays_inside(Path::new(name)) {
            wrong.push(format!("{name}: leads out of the bundle"));
            continue;
        }
        if full.is_symlink() {
            wrong.push(format!("{name}: a symbolic link, not a file"));
            listed.push(PathBuf::from(name));
            continue;
        }
        match InputFile::of(&full) {
            Ok(file) if file.sha256 == sha256 => {}
            Ok(_) => wrong.push(format!("{name}: changed")),
            Err(_) => wrong.push(format!("{name}: missing")),
        }
        listed.push(PathBuf::from(name));
    }
    let present = match files(bundle, Links::Refused) {
        Ok(present) => present,
        Err(failure) => {
            wrong.push(failure.text());
            Vec::new()
        }
    };
    for path in present {
        if path != Path::new(MANIFEST) && !listed.contains(&path) {
            wrong.push(format!("{}: not in the manifest", path.display()));
        }
    }
    if json {
        print_json(&serde_json::json!({ "files": listed.len(), "wrong": wrong }))?;
    } else if wrong.is_empty() {
        print_text(&format!("{} files as the manifest says\n", listed.len()))?;
    } else {
        print_text(&format!("{}\n", wrong.join("\n")))?;
    }
    Ok(if wrong.is_empty() {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}
