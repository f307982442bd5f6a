//! `cellpos generate`: completions and manual pages, for packages and for `~/.local`.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use clap_complete::Shell;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos generate`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  cellpos generate --out share

Writes share/completions/ (cellpos.bash, _cellpos, cellpos.fish) and share/man/ (a page for each command).")]
pub(crate) struct Args {
    /// The folder to write into.
    #[arg(long)]
    out: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Writes the files.
pub(crate) fn run(args: Args) -> CommandResult {
    let completions = args.out.join("completions");
    let man = args.out.join("man");
    for folder in [&completions, &man] {
        std::fs::create_dir_all(folder).map_err(|error| refused(folder, &error))?;
    }
    let mut files = Vec::new();
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        let mut command = crate::command_line();
        let path = clap_complete::generate_to(shell, &mut command, "cellpos", &completions)
            .map_err(|error| refused(&completions, &error))?;
        files.push(path);
    }
    // (Built again: the command line for completions contains `help` and its commands, which would each get a page.)
    let mut command = crate::command_line().disable_help_subcommand(true);
    command.build();
    manual(&command, &man, &mut files).map_err(|error| refused(&man, &error))?;
    files.sort();
    if args.json {
        print_json(&serde_json::json!({ "files": files }))?;
    } else {
        print_text(&format!("{}: {} files\n", args.out.display(), files.len()))?;
    }
    Ok(Outcome::Done)
}

/// Writes the pages of a command and its subcommands; adds each to `files`.
fn manual(command: &clap::Command, to: &Path, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    files.push(clap_mangen::Man::new(command.clone()).generate_to(to)?);
    for one in command.get_subcommands().filter(|one| !one.is_hide_set()) {
        manual(one, to, files)?;
    }
    Ok(())
}

fn refused(path: &Path, error: &std::io::Error) -> Failure {
    Failure::bad_input(
        format!("{}: cannot be written: {error}", path.display()),
        "name a folder that you may write to",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    fn named(command: &clap::Command, prefix: &str, names: &mut BTreeSet<String>) {
        names.insert(format!("{prefix}.1"));
        for one in command.get_subcommands() {
            named(one, &format!("{prefix}-{}", one.get_name()), names);
        }
    }

    #[test]
    fn each_command_has_a_page_and_no_other_page_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let args = Args {
            out: folder.path().to_owned(),
            json: true,
        };
        run(args).unwrap();
        let mut commands = BTreeSet::new();
        named(&crate::command_line(), "cellpos", &mut commands);
        let pages: BTreeSet<String> = std::fs::read_dir(folder.path().join("man"))
            .unwrap()
            .map(|page| page.unwrap().file_name().into_string().unwrap())
            .collect();
        assert_eq!(pages, commands);
        // The files that the unit of the package names exist.
        let packaging = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../packaging");
        let unit = std::fs::read_to_string(packaging.join("cellpos-run@.service")).unwrap();
        let referred: Vec<&str> = unit
            .lines()
            .filter_map(|line| line.strip_prefix("Documentation=man:")?.strip_suffix("(1)"))
            .collect();
        assert!(!referred.is_empty());
        for name in referred {
            assert!(pages.contains(&format!("{name}.1")), "{name}");
        }
    }
}
