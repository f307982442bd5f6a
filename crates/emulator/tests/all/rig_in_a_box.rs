//! Board and world on one virtual clock.

use cellpos_emulator::{BoardConfig, FaultKind, Faults, RigInABox, WorldConfig};
use cellpos_link::{
    Arm, BoardState, Command, Decoder, Fault, MAX_FRAME, PROTOCOL_VERSION, ToBoard, ToHost, encode,
    picometres,
};
use cellpos_plant::Model;

const MS: i64 = 1_000_000;

struct Bench {
    rig: RigInABox,
    decoder: Decoder<ToHost>,
    seq: u32,
}

impl Bench {
    fn new(world: &WorldConfig) -> Self {
        let rig = RigInABox::new(BoardConfig::default(), world, &Model::eq6(), 0).unwrap();
        let mut bench = Self {
            rig,
            decoder: Decoder::new(),
            seq: 0,
        };
        bench.say(
            &ToBoard::Hello {
                protocol: PROTOCOL_VERSION,
            },
            0,
        );
        bench.say(&ToBoard::Arm(Arm::session(1)), 0);
        bench
    }

    fn say(&mut self, message: &ToBoard, t_ns: i64) {
        let mut frame = [0; MAX_FRAME];
        let length = encode(message, &mut frame).unwrap();
        self.rig.receive(&frame[..length], t_ns);
    }

    fn command(&mut self, um: f64, t_ns: i64) {
        self.seq += 1;
        let command = Command {
            session: 1,
            seq: self.seq,
            time_us: (t_ns / 1000) as u64,
            displacement_pm: picometres(um).unwrap(),
            neutral_pm: 20_000_000,
        };
        self.say(&ToBoard::Command(command), t_ns);
    }

    fn hear(&mut self) -> Vec<ToHost> {
        let mut bytes = [0; 4096];
        let count = self.rig.transmit(&mut bytes);
        let mut rest = &bytes[..count];
        std::iter::from_fn(|| self.decoder.next_message(&mut rest)).collect()
    }
}

fn quiet(faults: Faults) -> WorldConfig {
    WorldConfig {
        diffusion_um2_per_s: 0.0,
        drift_um_per_s: 0.0,
        faults,
        ..WorldConfig::ideal()
    }
}

#[test]
fn a_command_moves_the_pzt_at_its_instant_and_the_bead_from_then_on() {
    let mut bench = Bench::new(&quiet(Faults::default()));
    bench.rig.advance_to(10 * MS);
    let rest_um = bench.rig.world().bead_um();
    bench.command(21.0, 12_345_678);
    assert!((bench.rig.applied_um() - 21.0).abs() < 4e-4);
    assert!(
        (bench.rig.world().bead_um() - rest_um).abs() < 1e-3,
        "not before"
    );
    bench.rig.advance_to(12_345_678 + MS);
    // 1 um for 1 ms at 379 um/s, and the feedthrough of 0.0187 um.
    let moved_um = bench.rig.world().bead_um() - rest_um;
    assert!((moved_um - 0.398).abs() < 0.01, "{moved_um}");
}

#[test]
fn the_same_seed_and_commands_give_the_same_bits_and_stops_in_between_leave_the_board_alone() {
    let run = |cuts: i64| {
        let faults = Faults {
            drop_rate: 0.05,
            garbage_per_s: 50.0,
            ..Faults::default()
        };
        let mut bench = Bench::new(&WorldConfig {
            faults,
            exposure_ms: 0.0,
            ..WorldConfig::ideal()
        });
        let mut positions = Vec::new();
        for k in 1..500 {
            for cut in 1..cuts {
                // Asking in between must not change what happens.
                let t_ns = k * MS + 1000 * cut;
                if bench.rig.next_event_ns() < t_ns {
                    let event_ns = bench.rig.next_event_ns();
                    bench.rig.advance_to(event_ns);
                }
            }
            bench.command(20.0 + 0.05 * (k as f64 * 0.1).sin(), k * MS + 300_000);
            bench.hear();
            while let Some(fix) = bench.rig.world_mut().take_position() {
                positions.push((fix.info.id, fix.x_um.to_bits()));
            }
        }
        (positions, bench.rig.board().status())
    };
    assert_eq!(run(1), run(1));
    assert!(run(1).1.bad_frames > 0);
    let (coarse, fine) = (run(1).1, run(5).1);
    assert_eq!(coarse.applied_pm, fine.applied_pm);
    assert_eq!(coarse.bad_frames, fine.bad_frames);
}

#[test]
fn a_lost_link_is_held_through_and_taken_up_again_when_it_is_back() {
    let faults = Faults::default().with(FaultKind::LinkLoss, 0.1, Some(0.5));
    let mut bench = Bench::new(&quiet(faults));
    let (mut held_at, mut parked_at) = (None, None);
    for k in 1..2200 {
        bench.command(20.0, k * MS);
        let heard = bench.hear();
        assert!(
            !(100..600).contains(&k) || heard.is_empty(),
            "nothing passes from 100 to 600 ms"
        );
        if bench.rig.board().state() == BoardState::Holding && held_at.is_none() {
            held_at = Some(k);
        }
        if bench.rig.board().state() == BoardState::Safe && parked_at.is_none() {
            parked_at = Some(k);
        }
    }
    // Last command at 99 ms, watchdog 20 ms; taken up again at 600 ms.
    assert_eq!((held_at, parked_at), (Some(119), None));
    let status = bench.rig.board().status();
    assert_eq!(
        (status.state, status.fault, status.holds),
        (BoardState::Running, Fault::None, 1)
    );
}

#[test]
fn scheduled_garbage_comes_each_millisecond_of_its_span_and_harms_nothing() {
    let faults = Faults::default().with(FaultKind::LinkGarbage, 0.05, Some(0.1));
    let mut bench = Bench::new(&quiet(faults));
    let mut bad = Vec::new();
    for k in 1..250 {
        bench.command(20.5, k * MS);
        let answered = bench
            .hear()
            .iter()
            .any(|message| matches!(message, ToHost::Status(s) if s.last_seq == Some(k as u32)));
        assert!(answered, "command {k} was obeyed and its status heard");
        bad.push(bench.rig.board().status().bad_frames);
    }
    assert_eq!(bad[48], 0);
    // Each burst ends in a bad frame with the next command's delimiter; zeros among its bytes can make more bad frames.
    assert!((99..200).contains(&bad[160]), "{}", bad[160]);
    assert_eq!(bad[160], bad[240], "none after the span");
    assert_eq!(bench.rig.board().state(), BoardState::Running);
}

#[test]
fn the_led_of_the_board_shows_in_the_frames_after_the_cameras_latency() {
    let mut bench = Bench::new(&quiet(Faults::default()));
    bench.say(&ToBoard::Led { on: true }, 20 * MS + 500_000);
    let mut first_lit = None;
    for k in 1..40 {
        bench.rig.advance_to(20 * MS + 500_000 + k * MS / 2);
        while let Some(fix) = bench.rig.world_mut().take_position() {
            if fix.info.lit > 0.0 && first_lit.is_none() {
                first_lit = Some(fix.info);
            }
        }
    }
    let info = first_lit.unwrap();
    assert_eq!((info.mid_exposure_ns, info.delivery_ns), (21 * MS, 23 * MS));
}
