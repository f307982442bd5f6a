//! What a millisecond of the emulated rig costs: board, plant, bead, camera; with positions and with pictures.
//!
//! Each line is the mean over a run on the virtual clock with a command and a status over the wire in each millisecond.
//! The competitor is the same run without any command, which leaves the world alone.

use cellpos_emulator::WorldConfig;
use cellpos_emulator::{BoardConfig, RigInABox};
use cellpos_link::{Arm, Command, Decoder, MAX_FRAME, PROTOCOL_VERSION, ToBoard, ToHost, encode};
use cellpos_plant::Model;
use std::hint::black_box;
use std::time::Instant;

#[derive(Clone, Copy, PartialEq)]
enum Take {
    Positions,
    Pictures,
}

fn us_per_ms(take: Take, commands: bool, milliseconds: u32) -> f64 {
    let world = WorldConfig {
        drift_um_per_s: 0.0,
        ..WorldConfig::default()
    };
    let mut rig = RigInABox::new(BoardConfig::default(), &world, &Model::eq6(), 0)
        .expect("the default rig runs");
    let mut wire = [0; MAX_FRAME];
    let mut say = |rig: &mut RigInABox, message: &ToBoard, t_ns: i64| {
        let length = encode(message, &mut wire).expect("MAX_FRAME suffices");
        rig.receive(&wire[..length], t_ns);
    };
    let hello = ToBoard::Hello {
        protocol: PROTOCOL_VERSION,
    };
    if commands {
        say(&mut rig, &hello, 0);
        say(&mut rig, &ToBoard::Arm(Arm::session(1)), 0);
    }
    let mut decoder = Decoder::<ToHost>::new();
    let (mut pixels, mut bytes) = (Vec::new(), [0; 512]);
    let start = Instant::now();
    for k in 1..=milliseconds {
        let t_ns = i64::from(k) * 1_000_000;
        rig.advance_to(t_ns);
        match take {
            Take::Positions => {
                black_box(rig.world_mut().take_position());
            }
            Take::Pictures => {
                black_box(rig.world_mut().take_frame(&mut pixels));
            }
        }
        if commands {
            let command = ToBoard::Command(Command {
                session: 1,
                seq: k,
                time_us: u64::from(k) * 1000,
                displacement_pm: 20_000_000 + ((k % 7) as i32 - 3) * 20_000,
                neutral_pm: 20_000_000,
            });
            say(&mut rig, &command, t_ns + 30_000);
            let count = rig.transmit(&mut bytes);
            let mut rest = &bytes[..count];
            while let Some(message) = decoder.next_message(&mut rest) {
                black_box(message);
            }
        }
    }
    start.elapsed().as_secs_f64() * 1e6 / f64::from(milliseconds)
}

fn main() {
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = cpu
        .lines()
        .find_map(|line| line.strip_prefix("model name"))
        .map_or("unknown", |rest| rest.trim_start_matches([' ', '\t', ':']));
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    println!("CPU {cpu}; load {}", load.trim());
    println!("{:<34} {:>12} {:>16}", "", "us per ms", "x real time");
    for (name, take, commands, milliseconds) in [
        ("positions, no commands", Take::Positions, false, 200_000),
        (
            "positions, commands and status",
            Take::Positions,
            true,
            200_000,
        ),
        ("pictures, no commands", Take::Pictures, false, 20_000),
        (
            "pictures, commands and status",
            Take::Pictures,
            true,
            20_000,
        ),
    ] {
        let best = (0..5)
            .map(|_| us_per_ms(take, commands, milliseconds))
            .fold(f64::INFINITY, f64::min);
        println!("{name:<34} {best:>12.3} {:>16.0}", 1000.0 / best);
    }
}
