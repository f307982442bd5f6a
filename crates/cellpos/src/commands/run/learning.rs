//! Learning on the periodic motions of a script, and what was learned as a file of the run.

use crate::cyclic::{LearnSpec, Wanted};
use crate::rig_file::RigFile;
use crate::setup::{MotionSpec, Prepared};
use cellpos_control::{LearnedTable, Learner, LearnerState};
use cellpos_script::{PeriodicReference, Plan};
use std::path::{Path, PathBuf};

use crate::cyclic::save_learning;
pub(crate) use crate::cyclic::{
    LEARNED_TOML, NamedTable, load_learned as load, save_learned as save,
};

/// Fewest cycles in full swing of a motion that is learned: two are watched, and some must be left to learn from.
const FEWEST_CYCLES: u64 = 5;
/// Most motions that are learned: the responses of each take a simulation.
const MOST_MOTIONS: usize = 16;

/// How the motions of a plan are learned, going on from `known`; what cannot be learned is a warning.
pub(crate) fn motions(
    plan: &Plan,
    setup: &Prepared,
    file: &RigFile,
    known: &[NamedTable],
    warnings: &mut Vec<String>,
) -> Vec<MotionSpec> {
    let mut specs = Vec::new();
    for (number, motion) in (0u16..).zip(plan.periodic()) {
        let Some(reference) = plan.periodic_reference(usize::from(number)) else {
            continue;
        };
        if motion.cycles < FEWEST_CYCLES {
            continue;
        }
        let name = motion.name();
        if specs.len() >= MOST_MOTIONS {
            warnings.push(format!(
                "not learned: {name}: more than {MOST_MOTIONS} motions"
            ));
            continue;
        }
        let wanted = Wanted {
            reference: &reference,
            from_s: PeriodicReference::FADE_S,
            frequency_hz: motion.frequency_hz,
            harmonics: motion.harmonics(),
        };
        let table = known.iter().find(|known| known.name == name);
        let table = table.map(|known| known.table.clone());
        let had = table.is_some();
        let spec = LearnSpec::new(setup, file, &wanted, table).or_else(|failure| {
            if had {
                warnings.push(format!("learned again: {name}: {}", failure.text()));
                LearnSpec::new(setup, file, &wanted, None)
            } else {
                Err(failure)
            }
        });
        match spec {
            Ok(learn) => specs.push(MotionSpec {
                motion: number,
                name,
                learn,
            }),
            Err(failure) => warnings.push(format!("not learned: {name}: {}", failure.text())),
        }
    }
    specs
}

/// Names and tables of the learned motions.
pub(crate) fn named(specs: &[MotionSpec], tables: &[Option<LearnedTable>]) -> Vec<NamedTable> {
    let table = |spec: &MotionSpec| tables.get(usize::from(spec.motion))?.clone();
    specs
        .iter()
        .filter_map(|spec| {
            Some(NamedTable {
                name: spec.name.clone(),
                table: table(spec)?,
            })
        })
        .collect()
}

/// Keeps the file up to date while the loop learns.
pub(crate) struct Keeper {
    folder: PathBuf,
    specs: Vec<MotionSpec>,
    learners: Vec<Option<Learner>>,
    tables: Vec<Option<LearnedTable>>,
    changed: bool,
}

impl Keeper {
    /// Writer for the run's folder; None if nothing is learned.
    pub(crate) fn new(folder: &Path, specs: &[MotionSpec], sample_s: f64) -> Option<Self> {
        let count = specs
            .iter()
            .map(|spec| usize::from(spec.motion) + 1)
            .max()?;
        let mut learners = vec![None; count];
        let mut tables = vec![None; count];
        for spec in specs {
            let learn = &spec.learn;
            learners[usize::from(spec.motion)] = learn.learner(sample_s).ok();
            tables[usize::from(spec.motion)] = learn.table.clone();
        }
        Some(Self {
            folder: folder.to_owned(),
            specs: specs.to_vec(),
            learners,
            tables,
            changed: false,
        })
    }

    /// What the loop knows now.
    pub(crate) fn take(&mut self, motion: u16, state: &LearnerState) {
        let number = usize::from(motion);
        if let (Some(Some(learner)), Some(table)) =
            (self.learners.get(number), self.tables.get_mut(number))
        {
            *table = Some(learner.table(state));
            self.changed = true;
        }
    }

    /// Writes what has changed. After a failed write the next change tries again; the run continues.
    pub(crate) fn save(&mut self) {
        if self.changed && save_learning(&self.folder, named(&self.specs, &self.tables)).is_ok() {
            self.changed = false;
        }
    }
}
