//! `cellpos generate`: completions and manual pages, for packages and for `~/.local`.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use clap_complete::Shell;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos generate`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  cellpos generate --out share

Writes share/completions/ (cellpos.bash, _cellpos, cellpos.fish) and share/man/ (a page for each command).")]
pub struct Args {
    /// The folder to write into.
    #[arg(long)]
    out: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Writes the files.
pub fn run(args: Args) -> CommandResult {
    let completions = args.out.join("completions");
    let man = args.out.join("man");
    for folder in [&completions, &man] {
        std::fs::create_dir_all(folder).map_err(|error| refused(folder, &error))?;
    }
    let mut command = crate::command_line();
    let mut files = Vec::new();
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        let path = clap_complete::generate_to(shell, &mut command, "cellpos", &completions)
            .map_err(|error| refused(&completions, &error))?;
        files.push(path);
    }
    clap_mangen::generate_to(command, &man).map_err(|error| refused(&man, &error))?;
    let pages = std::fs::read_dir(&man).map_err(|error| refused(&man, &error))?;
    files.extend(pages.flatten().map(|page| page.path()));
    files.sort();
    if args.json {
        print_json(&serde_json::json!({ "files": files }))?;
    } else {
        print_text(&format!("{}: {} files\n", args.out.display(), files.len()))?;
    }
    Ok(Outcome::Done)
}

fn refused(path: &Path, error: &std::io::Error) -> Failure {
    Failure::bad_input(
        format!("{}: cannot be written: {error}", path.display()),
        "name a folder that you may write to",
    )
}
