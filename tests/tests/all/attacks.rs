//! A few of each attack; the command `attack` runs them in the numbers of a night.

use cellpos_tests::attack::{self, Attacked, Chance};
use cellpos_tests::programs::alone;
use std::path::Path;

/// An attack in real time.
fn stands(attack: impl Fn(&Path, u64, &mut Chance) -> Attacked, tries: u64) {
    let _alone = alone();
    stands_beside_others(attack, tries);
}

fn stands_beside_others(attack: impl Fn(&Path, u64, &mut Chance) -> Attacked, tries: u64) {
    let folder = tempfile::tempdir().unwrap();
    let attacked = attack(folder.path(), tries, &mut Chance::new(7));
    assert!(attacked.tries >= 1, "{attacked:?}");
    assert!(attacked.broken.is_empty(), "{:#?}", attacked.broken);
}

#[test]
fn a_killed_program_goes_on_and_does_every_cycle_once() {
    stands(attack::kill_the_program, 2);
}

#[test]
fn damaged_inputs_get_an_answer() {
    stands_beside_others(attack::inputs::damaged_inputs, 70);
}

#[test]
fn a_hostile_camera_costs_no_tick_its_record() {
    // On the virtual clock.
    stands_beside_others(attack::cameras::hostile_cameras, 4);
}

#[test]
fn a_signalled_program_ends_and_leaves_a_run_that_reads() {
    stands(attack::stalls_and_signals, 3);
}
