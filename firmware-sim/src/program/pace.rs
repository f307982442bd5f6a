//! Waits on the monotonic clock, and delivers the frames that are due.

use super::error::ProgramError;
use super::frame_server::FrameServer;
use cellpos_emulator::World;
use cellpos_link::frames::FrameHeader;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::time::{ClockId, clock_gettime};
use std::os::fd::BorrowedFd;

/// Interval of wake-ups without work: exposures are not announced.
pub(super) const LONGEST_SLEEP_NS: i64 = 500_000;
/// Interval of unlocking the line and accepting new clients.
pub(super) const HOUSEKEEPING_NS: i64 = 20_000_000;

/// Now on the monotonic clock, ns.
pub(super) fn monotonic_ns() -> i64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}

/// Sends the frames delivered by now to the clients; returns their number.
pub(super) fn send_frames(
    world: &mut World,
    server: &mut FrameServer,
    pixels: &mut Vec<u8>,
) -> u64 {
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

/// Sleeps until `deadline_ns` or until `readiness` can be read. The time left is taken from the absolute deadline at the last
/// moment, so that delays do not add up.
pub(super) fn wait(
    readiness: Option<BorrowedFd<'_>>,
    deadline_ns: i64,
) -> Result<(), ProgramError> {
    let left_ns = (deadline_ns - monotonic_ns()).max(0);
    let timeout = Timespec {
        tv_sec: 0,
        tv_nsec: left_ns.min(LONGEST_SLEEP_NS),
    };
    let mut watched = readiness
        .as_ref()
        .map(|readiness| PollFd::new(readiness, PollFlags::IN));
    match poll(watched.as_mut_slice(), Some(&timeout)) {
        Ok(_) | Err(Errno::INTR) => Ok(()),
        Err(error) => Err(ProgramError::system("waiting")(error)),
    }
}
