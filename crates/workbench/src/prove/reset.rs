//! Test of a microcontroller that is reset while its output is away from park.

use super::moves::Range;
use super::sheet::Sheet;
use super::talk::Talk;
use super::trial::{Trial, of, um};
use cellpos_link::{BoardState, Request, ToBoard};
use cellpos_session::Failure;

const NAME: &str = "reset in mid-flight";

/// Moves the output off park, has the board reset, and watches the output before arming.
pub(super) fn reset(
    sheet: &mut Sheet,
    talk: &mut Option<Talk>,
    range: &Range,
    trial: &mut Trial,
) -> Result<(), Failure> {
    let Some(again) = &mut trial.reset else {
        sheet.leave(
            of(NAME),
            "--reset asks for it: somebody has to press the board's reset button",
        );
        return Ok(());
    };
    let Some(mut t) = talk.take() else {
        return Ok(());
    };
    // The end of the range that is farther from park.
    let far = |pm: &i32| (pm - range.own_park_pm).abs();
    let at_pm = [range.low_pm, range.high_pm].into_iter().max_by_key(far);
    let at_pm = at_pm.unwrap_or(range.high_pm);
    let armed = range.session(&mut t, |_| {}, Some((at_pm, at_pm)))?;
    let before = range.settle(&mut t, at_pm)?;
    let mut t = again(t)?;
    let hello = t.hello()?;
    let first = t.must_status()?;
    // The motion to park begins before anything else, and the board must not be armed during it.
    let refused = match range.is_at(&first, range.own_park_pm) {
        true => None,
        false => Some(range.session(&mut t, |_| {}, None)?),
    };
    let rest = range.settle(&mut t, range.own_park_pm)?;
    let restarted = first.board_time_us < before.board_time_us;
    sheet.judge(
        of(NAME),
        armed.is_ok()
            && hello.is_some()
            && restarted
            && first.state == BoardState::Disarmed
            && refused
                .as_ref()
                .is_none_or(|answer| answer.as_ref().is_err_and(|why| why == "state"))
            && range.is_at(&rest, range.own_park_pm),
        (um((rest.applied_pm - range.own_park_pm).abs()), "um"),
        "disarmed, ramps to its park displacement, and refuses to be armed (state) until it is there",
        format!(
            "{}; first seen at {:.3} um, then at {:.3} um; arm on the way: {}",
            if restarted {
                "its clock began again"
            } else {
                "its clock went on: no reset was seen"
            },
            um(first.applied_pm),
            um(rest.applied_pm),
            match refused {
                None => "not tried, it was at park already".to_string(),
                Some(Ok(())) => "armed".to_string(),
                Some(Err(why)) => why,
            }
        ),
    );
    t.request(&ToBoard::Disarm, Request::Disarm)?.ok();
    *talk = Some(t);
    Ok(())
}
