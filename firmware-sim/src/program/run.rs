//! Pacing: the box follows `CLOCK_MONOTONIC`.

use super::args::Args;
use super::around::Around;
use super::error::ProgramError;
use super::frame_server::FrameServer;
use super::line::Line;
use super::log::{Instant, Log};
use super::pace::{HOUSEKEEPING_NS, LONGEST_SLEEP_NS, monotonic_ns, send_frames, wait};
use super::usb::Usb;
use cellpos_emulator::RigInABox;
use rustix::mm::{MlockAllFlags, mlockall};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag::register;
use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Above the priority of the host's threads: a real camera and board do not wait for a busy host either.
const PRIORITY: u8 = 60;

/// Runs the box until the duration is over or a signal comes.
///
/// # Errors
/// Wrong input, or an error of the operating system.
pub(crate) fn run(args: &Args) -> Result<(), ProgramError> {
    let setup = args.setup()?;
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        register(signal, Arc::clone(&stop))
            .map_err(ProgramError::system("listening for signals"))?;
    }
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
            log.finish()?;
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
    let chunk = args.usb_chunks.map(usize::from);
    let mut usb = Usb::new(&args.line_stall, chunk, setup.world.seed, start_ns);
    let frames = pace(
        &mut rig,
        (&line, &mut usb),
        &mut server,
        log.as_mut(),
        end_ns,
        &stop,
    )?;
    if let Some(log) = &mut log {
        log.finish()?;
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

/// Prints the paths of the box.
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

/// Real-time scheduling, and the memory in use kept in RAM: a page that is fetched again stalls board and camera together.
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
    if let Err(error) = mlockall(MlockAllFlags::CURRENT) {
        eprintln!(
            "firmware-sim: DEGRADED: its memory was not locked ({error}): frames and board may lag behind by milliseconds; allow it \
             with `ulimit -l` or CAP_IPC_LOCK, or say --best-effort"
        );
    }
}

fn note(log: &mut Log, rig: &RigInABox) -> Result<(), ProgramError> {
    log.note(&Instant {
        now_ns: rig.now_ns(),
        applied_um: rig.applied_um(),
        pzt_um: rig.world().pzt_um(),
        bead_um: rig.world().bead_um(),
        state: &format!("{:?}", rig.board().state()),
        fault: &format!("{:?}", rig.board().fault()),
    })
}

/// The loop; returns the number of frames handed to clients.
fn pace(
    rig: &mut RigInABox,
    (line, usb): (&Line, &mut Usb),
    server: &mut FrameServer,
    mut log: Option<&mut Log>,
    end_ns: i64,
    stop: &AtomicBool,
) -> Result<u64, ProgramError> {
    let mut buffer = [0; 4096];
    let mut pixels = Vec::new();
    let (mut frames, mut watched, mut next_housekeeping_ns) = (0, false, 0);
    let mut was_stalled = false;
    loop {
        let now_ns = monotonic_ns();
        // The rows that are due, before anything that came since can act.
        while let Some(log) = log.as_deref_mut().filter(|log| log.next_ns() <= now_ns) {
            rig.advance_to(log.next_ns());
            note(log, rig)?;
        }
        let stalled = usb.is_stalled(now_ns);
        if stalled != was_stalled {
            line.stall(stalled)?;
            was_stalled = stalled;
        }
        let room = match stalled {
            true => 0,
            false => usb.packet(buffer.len(), now_ns),
        };
        let heard = match buffer.get_mut(..room) {
            Some(buffer) if room > 0 => line.read(buffer)?,
            _ => 0,
        };
        if heard > 0 {
            rig.receive(buffer.get(..heard).unwrap_or(&[]), now_ns);
        } else {
            rig.advance_to(now_ns);
        }
        loop {
            // One packet per turn; without packets, everything.
            let count = rig.transmit(buffer.get_mut(..room).unwrap_or(&mut []));
            if count == 0 {
                break;
            }
            line.write(buffer.get(..count).unwrap_or(&[]))?;
            if room < buffer.len() {
                break;
            }
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
            note(log, rig)?;
        }
        if stop.load(Ordering::Relaxed) || now_ns >= end_ns {
            return Ok(frames);
        }
        // Do not look at a line before its time if it is stalled or between two packets.
        let event_ns = rig.next_event_ns().min(usb.next_event_ns(now_ns));
        let event_ns = event_ns.min(log.as_ref().map_or(i64::MAX, |log| log.next_ns()));
        let readiness = (room > 0).then(|| line.readiness());
        wait(readiness, event_ns.min(now_ns + LONGEST_SLEEP_NS))?;
    }
}
