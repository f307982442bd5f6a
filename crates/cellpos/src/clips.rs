//! Clips of the camera's picture, kept with a run.

use cellpos_script::{ClipWishes, Plan};
use cellpos_session::clips::{ClipConfig, Clips, Schedule};
use cellpos_session::{Failure, Rig};
use std::path::Path;

/// The clips of the next run on a rig, into its folder. Without frames or on the virtual clock there are no clips; a warning says so if
/// they were asked for.
pub(crate) fn of(
    rig: &mut Rig,
    folder: &Path,
    asked: Option<&ClipWishes>,
) -> Result<Option<Clips>, Failure> {
    let source = rig.source();
    let none = match (rig.clock().is_virtual(), source.width_px) {
        (true, _) => Some("there are no pictures on the virtual clock (--clock real has them)"),
        (false, 0) => Some("there are no pictures with --frames off"),
        _ => None,
    };
    if let Some(why) = none {
        if asked.is_some() {
            tracing::warn!("[clips]: no clip is kept, because {why}");
        }
        return Ok(None);
    }
    let wishes = asked.cloned().unwrap_or_default();
    let config = ClipConfig {
        before_s: wishes.before_s,
        after_s: wishes.after_s,
        most_bytes: wishes.most_mb * 1_000_000,
    };
    let size = (source.width_px, source.height_px);
    let rate_hz = 1e6 / rig.file().timing.period_us;
    let (clips, taker) = Clips::open(folder, config, size, rate_hz)?;
    rig.watch(taker);
    Ok(Some(clips))
}

/// When a script wants clips, by its plan.
pub(crate) fn schedule(plan: &Plan, wishes: &ClipWishes) -> Schedule {
    let mut schedule = Schedule::new();
    for number in &wishes.cycles {
        let Some(cycle) = plan.cycle(number.saturating_sub(1)) else {
            continue;
        };
        for phase in &wishes.phases {
            let at_s = cycle.start_s + phase * cycle.duration_s;
            schedule.push((at_s, format!("cycle-{number:06}-phase-{phase:.2}")));
        }
    }
    schedule.sort_by(|a, b| a.0.total_cmp(&b.0));
    schedule
}

/// Summary of the clips of a run that is over.
pub(crate) fn warnings(clips: Option<Clips>) -> Vec<String> {
    let Some(clips) = clips else {
        return Vec::new();
    };
    let report = clips.finish();
    let mut said = Vec::new();
    if report.no_room > 0 {
        said.push(format!(
            "{} clips were not kept: those before them took all that most_mb in [clips] allows",
            report.no_room
        ));
    }
    if let Some(error) = report.first_error {
        said.push(format!("a clip could not be written: {error}"));
    }
    if report.frames_left_out > 0 && !report.written.is_empty() {
        said.push(format!(
            "{} frames are in no clip: they came while clips were written",
            report.frames_left_out
        ));
    }
    said
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_script::Script;

    #[test]
    fn clips_stand_where_the_cycles_of_the_plan_are() {
        let text = "[clips]\ncycles = [10, 1, 99]\nphases = [0.0, 0.5]\n[[step]]\ndo = \"hold\"\nduration = \"1s\"\n\
                    [[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"2Hz\"\ncycles = 20\n";
        let script = Script::parse(text, "t.toml").unwrap();
        let plan = Plan::new(&script).unwrap();
        let schedule = schedule(&plan, &script.clips.unwrap());
        let times: Vec<f64> = schedule.iter().map(|moment| moment.0).collect();
        assert_eq!(times, [1.0, 1.25, 5.5, 5.75], "cycle 99 does not exist");
        assert_eq!(schedule[3].1, "cycle-000010-phase-0.50");
    }
}
