//! A tick, rings and all, allocates nothing: shown by an allocator that counts.

use crate::common::{START_UM, controller, core, measurement, report};
use cellpos_control::ControllerKind;
use cellpos_counting_alloc::{allocations, allocations_of};
use cellpos_rig::Clock;
use cellpos_runtime::ticker::{RingSizes, Ticker};
use cellpos_runtime::{Action, Heard, Life, Request};
use cellpos_vision::FixQuality;

/// Ticks through arming, running, coasting, freezing, a stale frame, a stop by the operator and Safe.
fn allocations_per_run(kind: ControllerKind) -> (u64, usize) {
    let clock = Clock::virtual_at(0);
    let (mut ticker, mut ends) = Ticker::new(
        core(&controller(kind), false),
        None,
        clock.clone(),
        0,
        RingSizes::default(),
    );
    let before = allocations();
    let (mut ran, mut applied_um) = (0, START_UM);
    for k in 0..3000_u64 {
        let due_ns = k as i64 * 1_000_000;
        clock.sleep_until_ns(due_ns);
        let wobble_um = 0.1 * ((k * 7919) % 13) as f64 - 0.6;
        let mut m = measurement(k, wobble_um);
        match k {
            500..510 | 700..900 => m.verdict = FixQuality::NoSignal,
            // Nothing comes at all.
            1000..1030 => m.frame_id = 0,
            // An old buffer under a new id.
            1100 => m.mid_exposure_ns -= 10_000_000,
            _ => {}
        }
        if m.frame_id > 0 {
            ends.measurements.push(m).unwrap();
        }
        let request = match k {
            1500..1600 => Request::Freeze,
            2500.. => Request::Park,
            _ => Request::None,
        };
        let mut said = report(k);
        said.applied_um = applied_um;
        let heard = Heard {
            report: Some(said),
            ..Heard::default()
        };
        ends.heard.push(heard).unwrap();
        ran += usize::from(ticker.tick(due_ns, request) == Life::Running);
        // The other ends of the rings, which live on threads that may allocate, do not here.
        while let Ok(order) = ends.orders.pop() {
            if let Action::Command { command_um, .. } = order.action {
                applied_um = command_um;
            }
        }
        while ends.feed.records.pop().is_ok() {}
        while ends.feed.events.pop().is_ok() {}
    }
    (allocations() - before, ran)
}

#[test]
fn no_tick_allocates_whatever_happens() {
    for kind in [
        ControllerKind::Pi,
        ControllerKind::Lead,
        ControllerKind::Lqg,
        ControllerKind::Mpc,
    ] {
        let (count, ran) = allocations_per_run(kind);
        assert!(
            ran > 2400,
            "{kind:?}: the loop was closed for {ran} ticks only"
        );
        assert_eq!(count, 0, "{kind:?}");
    }
}

#[test]
fn the_allocator_counts() {
    let count = allocations_of(|| drop(std::hint::black_box(vec![1_u8; 64])));
    assert_eq!(count, 1);
}
