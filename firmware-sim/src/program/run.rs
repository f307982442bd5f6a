//! Pacing: the box follows `CLOCK_MONOTONIC`.

use super::args::Args;
use super::around::Around;
use super::error::ProgramError;
use super::frame_server::FrameServer;
use super::line::Line;
use super::log::{Instant, Log};
use cellpos_emulator::{RigInABox, World};
use cellpos_link::frames::FrameHeader;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::time::{ClockId, clock_gettime};
use std::io::Write;
use std::os::fd::BorrowedFd;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Without anything to do the box still wakes up this often: exposures are not announced.
pub const LONGEST_SLEEP_NS: i64 = 500_000;
/// How often the line is unlocked and new clients are let in.
pub const HOUSEKEEPING_NS: i64 = 20_000_000;
/// Above the host's threads: a camera and a board do not wait for a busy host either.
const PRIORITY: u8 = 60;

pub fn monotonic_ns() -> i64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}

/// Runs the box until the duration is over or a signal comes.
///
/// # Errors
/// Wrong input, or what the operating system refuses.
pub fn run(args: &Args) -> Result<(), ProgramError> {
    let setup = args.setup()?;
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    ctrlc::set_handler(move || asked.store(true, Ordering::Relaxed)).map_err(|error| {
        ProgramError::System {
            doing: "listening for signals",
            source: std::io::Error::other(error),
        }
    })?;
    let start_ns = monotonic_ns();
    let socket = args.socket.clone().unwrap_or_else(|| {
        std::env::temp_dir().join(format!("firmware-sim-{}.sock", std::process::id()))
    });
    let mut server = FrameServer::listen(&socket)?;
    let mut log = match &args.log {
        Some(path) => Some(Log::create(path, start_ns)?),
        None => None,
    };
    let end_ns = args.duration.map_or(i64::MAX, |duration| {
        start_ns.saturating_add((duration.value() * 1e9) as i64)
    });
    if let Some(path) = &args.board {
        let mut around = Around::open(path, &setup, start_ns)?;
        announce(path, None, &server)?;
        if !args.best_effort {
            ask_for_real_time();
        }
        let frames = around.pace(&mut server, log.as_mut(), end_ns, &stop)?;
        if let Some(log) = &mut log {
            log.flush()?;
        }
        eprintln!(
            "firmware-sim: {frames} frames sent ({} skipped for slow readers); {} codes heard, applied {:.3} um",
            server.skipped,
            around.heard(),
            around.applied_um(),
        );
        return Ok(());
    }
    let mut rig = RigInABox::new(setup.board, &setup.world, &setup.model, start_ns)?;
    let line = Line::open(args.pty_link.as_deref())?;
    announce(line.path(), args.pty_link.as_deref(), &server)?;
    if !args.best_effort {
        ask_for_real_time();
    }
    let frames = pace(&mut rig, &line, &mut server, log.as_mut(), end_ns, &stop)?;
    if let Some(log) = &mut log {
        log.flush()?;
    }
    let status = rig.board().status();
    eprintln!(
        "firmware-sim: {:.1} s, {frames} frames sent ({} skipped for slow readers); board {:?}, fault {:?}, \
         applied {:.3} um, bad frames {}, ignored {}, late {}, clipped {}",
        (rig.now_ns() - start_ns) as f64 * 1e-9,
        server.skipped,
        status.state,
        status.fault,
        rig.applied_um(),
        status.bad_frames,
        status.ignored,
        status.late,
        status.clipped,
    );
    Ok(())
}

/// Says where the box can be found.
fn announce(board: &Path, link: Option<&Path>, server: &FrameServer) -> Result<(), ProgramError> {
    let mut out = std::io::stdout().lock();
    let mut say = || -> std::io::Result<()> {
        writeln!(out, "board  {}", board.display())?;
        if let Some(link) = link {
            writeln!(out, "link   {}", link.display())?;
        }
        writeln!(out, "camera {}", server.path().display())?;
        out.flush()
    };
    say().map_err(ProgramError::system("writing to standard output"))
}

fn ask_for_real_time() {
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let granted = ThreadPriorityValue::try_from(PRIORITY)
        .map_err(|error| error.to_string())
        .and_then(|priority| {
            set_thread_priority_and_policy(
                thread_native_id(),
                ThreadPriority::Crossplatform(priority),
                fifo,
            )
            .map_err(|error| format!("{error:?}"))
        });
    if let Err(error) = granted {
        eprintln!(
            "firmware-sim: DEGRADED: SCHED_FIFO was refused ({error}): frames and board may lag behind by \
             milliseconds; allow it with `ulimit -r {PRIORITY}` or CAP_SYS_NICE, or say --best-effort"
        );
    }
}

/// The loop; returns the number of frames handed to clients.
fn pace(
    rig: &mut RigInABox,
    line: &Line,
    server: &mut FrameServer,
    mut log: Option<&mut Log>,
    end_ns: i64,
    stop: &AtomicBool,
) -> Result<u64, ProgramError> {
    let mut buffer = [0; 4096];
    let mut pixels = Vec::new();
    let (mut frames, mut watched, mut next_housekeeping_ns) = (0, false, 0);
    loop {
        let now_ns = monotonic_ns();
        let heard = line.read(&mut buffer)?;
        if heard > 0 {
            rig.receive(buffer.get(..heard).unwrap_or(&[]), now_ns);
        } else {
            rig.advance_to(now_ns);
        }
        loop {
            let count = rig.transmit(&mut buffer);
            if count == 0 {
                break;
            }
            line.write(buffer.get(..count).unwrap_or(&[]))?;
        }
        if now_ns >= next_housekeeping_ns {
            next_housekeeping_ns = now_ns + HOUSEKEEPING_NS;
            line.unlock();
            watched = server.accept();
        }
        if watched {
            frames += send_frames(rig.world_mut(), server, &mut pixels);
        } else {
            while rig.world_mut().take_position().is_some() {}
        }
        if let Some(log) = log.as_deref_mut() {
            log.note(&Instant {
                now_ns: rig.now_ns(),
                applied_um: rig.applied_um(),
                pzt_um: rig.world().pzt_um(),
                bead_um: rig.world().bead_um(),
                state: &format!("{:?}", rig.board().state()),
                fault: &format!("{:?}", rig.board().fault()),
            })?;
        }
        if stop.load(Ordering::Relaxed) || now_ns >= end_ns {
            return Ok(frames);
        }
        wait(
            line.readiness(),
            rig.next_event_ns().min(now_ns + LONGEST_SLEEP_NS),
        )?;
    }
}

/// Hands the frames that have been delivered by now to the clients; returns how many.
pub fn send_frames(world: &mut World, server: &mut FrameServer, pixels: &mut Vec<u8>) -> u64 {
    let (width, height) = (world.config().width_px, world.config().height_px);
    let mut frames = 0;
    while let Some(info) = world.take_frame(pixels) {
        let header = FrameHeader {
            frame_id: info.id,
            mid_exposure_ns: u64::try_from(info.mid_exposure_ns).unwrap_or(0),
            sent_ns: u64::try_from(monotonic_ns()).unwrap_or(0),
            exposure_ns: u32::try_from(info.exposure_ns).unwrap_or(u32::MAX),
            width,
            height,
            bits: 8,
        };
        server.send(&header, pixels);
        frames += 1;
    }
    frames
}

/// Sleeps until `deadline_ns` or until the host has written. The time left is taken from the absolute deadline at the last
/// moment, so that delays do not add up.
pub fn wait(readiness: BorrowedFd<'_>, deadline_ns: i64) -> Result<(), ProgramError> {
    let left_ns = (deadline_ns - monotonic_ns()).max(0);
    let timeout = Timespec {
        tv_sec: 0,
        tv_nsec: left_ns.min(LONGEST_SLEEP_NS),
    };
    match poll(
        &mut [PollFd::new(&readiness, PollFlags::IN)],
        Some(&timeout),
    ) {
        Ok(_) | Err(Errno::INTR) => Ok(()),
        Err(error) => Err(ProgramError::system("waiting")(error)),
    }
}
