//! The failure of a session's call.

use cellpos_runtime::RunError;

/// The reason of a failure.
#[derive(Debug)]
pub enum Failure {
    /// The user can correct it: a file, key, value or argument. Exit code 2.
    BadInput(miette::Report),
    /// Something failed during the work: a device, a full disk, the loop. Exit code 1.
    Failed(miette::Report),
}

impl Failure {
    /// Bad input, with a help line that says what would be right.
    pub fn bad_input(error: impl std::fmt::Display, help: impl std::fmt::Display) -> Self {
        Self::BadInput(miette::miette!(help = help.to_string(), "{error}"))
    }

    /// A failure during the work, in the words of its error and of the errors that caused it.
    pub fn failed(error: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self::Failed(miette::Report::from_err(error))
    }

    /// A run that failed, with the expectation and the remedy if known.
    pub fn of_run(error: RunError) -> Self {
        match error {
            RunError::RecorderHangs { .. } => Self::Failed(miette::miette!(
                help = "expected a disk that answers; check the disk with the run folder (see the system log), or name another folder with --runs; earlier rows are kept, and the PZT is parked",
                "{error}"
            )),
            error => Self::failed(error),
        }
    }

    /// In a line.
    pub fn text(&self) -> String {
        match self {
            Self::BadInput(report) | Self::Failed(report) => report.to_string(),
        }
    }

    /// The same failure with one more remedy after its own.
    #[must_use]
    pub fn with_remedy(self, remedy: &str) -> Self {
        let add = |report: miette::Report| {
            let own = report.help().map(|help| format!("{help}; "));
            let error: &(dyn std::error::Error + Send + Sync) = report.as_ref();
            let help = format!("{}{remedy}", own.unwrap_or_default());
            miette::miette!(help = help, "{}", describe(error))
        };
        match self {
            Self::BadInput(report) => Self::BadInput(add(report)),
            Self::Failed(report) => Self::Failed(add(report)),
        }
    }

    /// Bad input, in the words of a library's error.
    pub fn input(error: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self::BadInput(miette::Report::from_err(error))
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::BadInput(report) | Self::Failed(report) => report.fmt(f),
        }
    }
}

impl std::error::Error for Failure {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::BadInput(report) | Self::Failed(report) => report.source(),
        }
    }
}

/// An error and its causes on one line, without repetitions.
pub fn describe(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        let behind = error.to_string();
        if !text.contains(&behind) {
            text.push_str(": ");
            text.push_str(&behind);
        }
        source = error.source();
    }
    text
}
