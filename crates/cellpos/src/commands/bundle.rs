//! `cellpos bundle`: a run, packed for archiving, with a manifest that any SHA-256 tool checks.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_record::{InputFile, RunReader};
use std::path::{Path, PathBuf};

/// Name of the manifest.
const MANIFEST: &str = "MANIFEST.sha256";
/// Folder of the files that went into the run.
const INPUTS: &str = "inputs";

/// Arguments of `cellpos bundle`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos bundle runs/20261121T190000Z-fatigue
  cellpos bundle --verify runs/20261121T190000Z-fatigue-bundle

A bundle is a plain folder: the run with all its sessions, the files that went into it as far as they are still what they
were, and MANIFEST.sha256, which sha256sum -c reads too. Exit code 1: a bundle is not what its manifest says.")]
pub struct Args {
    /// The run's folder.
    #[arg(required_unless_present = "verify", conflicts_with = "verify")]
    run: Option<PathBuf>,
    /// The folder to make; left out: the run's with -bundle behind its name.
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
pub fn run(args: Args) -> CommandResult {
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

/// Files below a folder, in order, as paths from it.
fn files(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let mut found = Vec::new();
    let mut open = vec![PathBuf::new()];
    while let Some(below) = open.pop() {
        let here = folder.join(&below);
        for entry in std::fs::read_dir(&here).map_err(io("cannot read", &here))? {
            let entry = entry.map_err(io("cannot read", &here))?;
            let path = below.join(entry.file_name());
            let kind = entry.file_type().map_err(io("cannot read", &here))?;
            if kind.is_dir() {
                open.push(path);
            } else if kind.is_file() {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}

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
    let out = out.map_or_else(
        || {
            let mut name = run.file_name().unwrap_or("run".as_ref()).to_owned();
            name.push("-bundle");
            run.with_file_name(name)
        },
        Path::to_owned,
    );
    if out.exists() {
        return Err(Failure::bad_input(
            format!("{} is there already", out.display()),
            "a bundle is never overwritten: give another --out",
        ));
    }
    // Made under another name first: a folder of the wanted name is a whole bundle.
    let mut part = out.clone().into_os_string();
    part.push(".part");
    let part = PathBuf::from(part);
    if part.exists() {
        std::fs::remove_dir_all(&part).map_err(io("cannot remove", &part))?;
    }
    for path in files(run)? {
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
    let packed = files(&part)?;
    for path in &packed {
        let file = InputFile::of(&part.join(path)).map_err(Failure::failed)?;
        bytes += file.bytes;
        manifest.push_str(&format!("{}  {}\n", file.sha256, path.display()));
    }
    let path = part.join(MANIFEST);
    std::fs::write(&path, manifest).map_err(io("cannot write", &path))?;
    std::fs::rename(&part, &out).map_err(io("cannot make", &out))?;
    if json {
        print_json(&serde_json::json!({
            "bundle": out, "files": packed.len(), "bytes": bytes, "inputs_missing": missing,
        }))?;
    } else {
        print_text(&format!(
            "{}: {} files, {bytes} bytes\n",
            out.display(),
            packed.len()
        ))?;
        for path in missing {
            print_text(&format!(
                "not packed, gone or changed since the run: {path}\n"
            ))?;
        }
    }
    Ok(Outcome::Done)
}

fn verify(bundle: &Path, json: bool) -> CommandResult {
    let path = bundle.join(MANIFEST);
    let manifest = std::fs::read_to_string(&path).map_err(|error| {
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
        match InputFile::of(&bundle.join(name)) {
            Ok(file) if file.sha256 == sha256 => {}
            Ok(_) => wrong.push(format!("{name}: changed")),
            Err(_) => wrong.push(format!("{name}: missing")),
        }
        listed.push(PathBuf::from(name));
    }
    for path in files(bundle)? {
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
