//! `--notify`: a command of the user's when a run ends, stops or goes safe.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// How long the user's command is waited for; then it is left to itself.
const PATIENCE: Duration = Duration::from_secs(10);

/// Options of commands that can take a night.
#[derive(Debug, clap::Args)]
pub(crate) struct NotifyArgs {
    /// Shell command that runs after the end, with the PZT parked. CELLPOS_EVENT is end, stop, safe or failed; CELLPOS_REASON a sentence; CELLPOS_RUN the folder; CELLPOS_NAME the name.
    #[arg(long, value_name = "COMMAND")]
    notify: Option<String>,
}

/// Contents of a notification.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum What {
    /// The run came to its end.
    End,
    /// The operator, or a condition of the script, stopped it.
    Stop,
    /// It went safe.
    Safe,
    /// It was never begun, or could not be carried through.
    Failed,
}

impl What {
    fn name(self) -> &'static str {
        match self {
            Self::End => "end",
            Self::Stop => "stop",
            Self::Safe => "safe",
            Self::Failed => "failed",
        }
    }
}

impl NotifyArgs {
    /// Runs the user's command, if there is one; what went wrong with it comes back as a sentence.
    pub(crate) fn tell(
        &self,
        what: What,
        name: &str,
        reason: &str,
        run: Option<&str>,
    ) -> Option<String> {
        let line = self.notify.as_deref()?;
        let child = Command::new("sh")
            .arg("-c")
            .arg(line)
            .env("CELLPOS_EVENT", what.name())
            .env("CELLPOS_NAME", name)
            .env("CELLPOS_REASON", reason)
            .env("CELLPOS_RUN", run.unwrap_or(""))
            // Its output goes to standard error, because standard output holds the result.
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn();
        match child {
            Ok(child) => wait(child).map(|problem| format!("--notify: {problem}")),
            Err(error) => Some(format!("--notify: sh could not be started: {error}")),
        }
    }

    /// The same at the end of a script, by the word for its outcome.
    pub(crate) fn of_a_script(&self, outcome: &str, reason: &str, folder: &Path) -> Option<String> {
        let what = match outcome {
            "done" => What::End,
            "stopped" | "aborted" => What::Stop,
            _ => What::Safe,
        };
        let name = folder.file_name().unwrap_or(folder.as_os_str());
        self.tell(what, &name.to_string_lossy(), reason, folder.to_str())
    }
}

fn wait(mut child: Child) -> Option<String> {
    let start = Instant::now();
    while start.elapsed() < PATIENCE {
        match child.try_wait() {
            Ok(Some(status)) if status.success() => return None,
            Ok(Some(status)) => return Some(format!("the command ended with {status}")),
            Ok(None) => std::thread::sleep(Duration::from_millis(20)),
            Err(error) => return Some(error.to_string()),
        }
    }
    Some(format!(
        "the command still runs after {} s; cellpos does not wait for it",
        PATIENCE.as_secs()
    ))
}
