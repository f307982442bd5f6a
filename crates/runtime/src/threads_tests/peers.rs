//! Peers that nobody of this project wrote: boards that answer late, twice or out of another session, cameras whose clock or rate changes.

use super::*;

/// What a peer does. Times count from the time at which the board was switched on, ns.
#[derive(Debug, Clone, Default)]
pub(super) struct Peers {
    /// The board's answers come late by a time in this range, in their order.
    pub(super) answers_late_ns: Option<(i64, i64)>,
    /// Probability that an answer comes twice.
    pub(super) answers_twice: f64,
    /// From then on the board obeys nothing, and each answer is one of the session before.
    pub(super) forgets_ns: Option<i64>,
    /// From then on the stamps of the frames are so much earlier.
    pub(super) stamps_back_ns: Option<(i64, i64)>,
    /// From then on the stamps run backwards.
    pub(super) clock_runs_back_ns: Option<i64>,
    /// In this span every second frame is not made.
    pub(super) half_the_rate_ns: Option<(i64, i64)>,
    /// Each so many ns the camera is silent for so long, and delivers at once what it has.
    pub(super) silences_ns: Option<(i64, i64)>,
    /// Frames that come from one time to another are so much later, in their order.
    pub(super) frames_late_ns: Option<([i64; 2], i64)>,
    /// From one time to another the machine does not run the control thread.
    pub(super) stall_ns: Option<[i64; 2]>,
    /// From one time to another it does not run the board's thread.
    pub(super) board_thread_stalls_ns: Option<[i64; 2]>,
}

impl Peers {
    /// The stamp that the camera gives.
    pub(super) fn stamp_ns(&self, mid_exposure_ns: i64) -> i64 {
        let stamp_ns = match self.clock_runs_back_ns {
            Some(from_ns) if mid_exposure_ns > from_ns => 2 * from_ns - mid_exposure_ns,
            _ => mid_exposure_ns,
        };
        match self.stamps_back_ns {
            Some((from_ns, by_ns)) if mid_exposure_ns > from_ns => stamp_ns - by_ns,
            _ => stamp_ns,
        }
    }

    /// When a frame arrives.
    pub(super) fn arrival_ns(&self, arrives_ns: i64) -> i64 {
        let arrives_ns = match self.frames_late_ns {
            Some(([from_ns, to_ns], by_ns)) if arrives_ns >= from_ns => {
                arrives_ns.max((arrives_ns + by_ns).min(to_ns + by_ns))
            }
            _ => arrives_ns,
        };
        match self.silences_ns {
            Some((every_ns, silence_ns)) => {
                arrives_ns.max(arrives_ns / every_ns * every_ns + silence_ns)
            }
            None => arrives_ns,
        }
    }
}

/// The answers of a board on their way to the host.
#[derive(Debug, Clone)]
pub(super) struct Answers {
    peers: Peers,
    dice: Dice,
    /// Bytes of an answer that is not whole.
    partial: Vec<u8>,
    /// Answers so far, and the second one: after that to hello, the first status.
    sent: usize,
    old: Vec<u8>,
    on_their_way: VecDeque<(i64, Vec<u8>)>,
}

impl Answers {
    pub(super) fn new(peers: &Peers, seed: u64) -> Self {
        Self {
            peers: peers.clone(),
            dice: Dice::new(seed ^ 0x7777),
            partial: Vec::new(),
            sent: 0,
            old: Vec::new(),
            on_their_way: VecDeque::new(),
        }
    }

    /// The board sends these bytes.
    pub(super) fn sent(&mut self, bytes: &[u8], now_ns: i64) {
        for &byte in bytes {
            self.partial.push(byte);
            // A zero is before and behind each answer.
            if byte != 0 || self.partial.len() == 1 {
                continue;
            }
            let whole = std::mem::take(&mut self.partial);
            self.sent += 1;
            if self.sent == 2 {
                self.old.clone_from(&whole);
            }
            let forgot = self.peers.forgets_ns.is_some_and(|ns| now_ns >= ns);
            let late_ns = (self.peers.answers_late_ns)
                .map_or(0, |(least, most)| self.dice.within(least, most));
            let before_ns = self.on_their_way.back().map_or(0, |(ns, _)| *ns);
            let at_ns = before_ns.max(now_ns + late_ns);
            let copies = 1 + usize::from(self.dice.hits(self.peers.answers_twice));
            for _ in 0..copies {
                let answer = if forgot { &self.old } else { &whole };
                self.on_their_way.push_back((at_ns, answer.clone()));
            }
        }
    }

    /// Takes what has arrived.
    pub(super) fn take(&mut self, buffer: &mut [u8], now_ns: i64) -> usize {
        let mut length = 0;
        while let Some((_, answer)) = (self.on_their_way.front_mut())
            .filter(|(ns, answer)| *ns <= now_ns && length + answer.len() <= buffer.len())
        {
            buffer[length..length + answer.len()].copy_from_slice(answer);
            length += answer.len();
            self.on_their_way.pop_front();
        }
        length
    }
}

/// Whether the bead was where it should be in the last 300 ticks. A camera at half the rate shows it in every second one.
fn is_held(ran: &Ran) -> bool {
    let last = ran.records.iter().rev().take(300);
    let seen: Vec<_> = last.filter(|r| r.measured_um.is_finite()).collect();
    let held = (seen.iter()).filter(|r| (r.measured_um - r.target_um).abs() < 3.0);
    seen.len() >= 100 && held.count() * 10 >= seen.len() * 9
}

/// The run of 4 s with a peer, with what every run must keep.
fn with(seed: u64, peers: Peers, camera_hz: f64) -> Ran {
    let faults = Faults {
        // A board that forgot obeys nobody.
        deaf: peers.forgets_ns,
        peers,
        camera_hz,
        ..Faults::default()
    };
    let ran = run(seed, 4000, &faults, &[]);
    check(&ran, &faults);
    replays(&ran);
    let end = ran.end.as_ref().expect("control lives");
    assert!(
        end.end != End::Duration || is_held(&ran),
        "it ended well without its bead: {faults:?}"
    );
    assert_eq!(
        (end.account.records_lost, ran.report.records_unkept),
        (0, 0),
        "{faults:?}"
    );
    ran
}

fn reason(ran: &Ran) -> Option<SafeReason> {
    ran.end.as_ref().and_then(|end| end.safe_reason)
}

#[test]
fn a_board_that_answers_late_and_twice_holds_the_bead_and_no_command_counts_as_lost() {
    for seed in 0..6 {
        let peers = Peers {
            answers_late_ns: Some((3 * MS, 30 * MS)),
            answers_twice: if seed % 2 == 0 { 0.5 } else { 1.0 },
            ..Peers::default()
        };
        let ran = with(seed, peers, 1000.0);
        assert_eq!(reason(&ran), None, "seed {seed}");
        let lost = |r: &&TickRecord| r.flags.has(TickFlags::COMMAND_LOST);
        assert_eq!(ran.records.iter().filter(lost).count(), 0, "seed {seed}");
        // At the end the answers of the last 30 ms are on their way.
        let account = ran.commands.expect("counted");
        assert!(account.lost_in_all() <= 30, "seed {seed}: {account:?}");
    }
}

#[test]
fn a_board_that_answers_out_of_an_old_session_ends_the_run_by_its_name() {
    for seed in 0..4 {
        let peers = Peers {
            forgets_ns: Some(2000 * MS),
            ..Peers::default()
        };
        assert_eq!(
            reason(&with(seed, peers, 1000.0)),
            Some(SafeReason::BoardForeign),
            "seed {seed}"
        );
    }
}

#[test]
fn a_camera_whose_clock_runs_or_steps_back_is_noticed() {
    for (back_ns, ends) in [(MS / 4, false), (40 * MS, true), (3_600_000 * MS, true)] {
        let peers = Peers {
            stamps_back_ns: Some((2000 * MS, back_ns)),
            ..Peers::default()
        };
        let expected = ends.then_some(SafeReason::StaleFrames);
        assert_eq!(reason(&with(3, peers, 1000.0)), expected, "{back_ns} ns");
    }
    let peers = Peers {
        clock_runs_back_ns: Some(2000 * MS),
        ..Peers::default()
    };
    assert_eq!(
        reason(&with(4, peers, 1000.0)),
        Some(SafeReason::StaleFrames)
    );
}

#[test]
fn old_frames_end_a_run_unless_the_machine_stalled_just_before() {
    let at_ns = 2000 * MS;
    for stall_ms in [0, 3, 20, 60] {
        // The frames of the stall come with it, and as long afterwards.
        let late_ms = 2 * stall_ms.max(8);
        let peers = Peers {
            stall_ns: Some([at_ns, at_ns + stall_ms * MS]),
            frames_late_ns: Some(([at_ns, at_ns + late_ms * MS], 5 * MS)),
            ..Peers::default()
        };
        let expected = (stall_ms < 20).then_some(SafeReason::StaleFrames);
        assert_eq!(reason(&with(6, peers, 1000.0)), expected, "{stall_ms} ms");
    }
    // Those that stay old end it all the same.
    let peers = Peers {
        stall_ns: Some([at_ns, at_ns + 40 * MS]),
        frames_late_ns: Some(([at_ns, 3500 * MS], 5 * MS)),
        ..Peers::default()
    };
    let ends = reason(&with(7, peers, 1000.0));
    assert_eq!(ends, Some(SafeReason::StaleFrames));
}

#[test]
fn a_rate_that_changes_in_mid_run_loses_no_bead_in_silence() {
    for (camera_hz, span_ns) in [
        (1000.0, (2000 * MS, 10_000 * MS)),
        (1000.0, (1500 * MS, 2500 * MS)),
        (2000.0, (0, 2000 * MS)),
    ] {
        for seed in 0..3 {
            let peers = Peers {
                half_the_rate_ns: Some(span_ns),
                ..Peers::default()
            };
            println!(
                "{camera_hz} Hz, {span_ns:?}: {:?}",
                reason(&with(seed, peers, camera_hz))
            );
        }
    }
}

#[test]
fn bursts_after_40_ms_of_silence_end_no_run() {
    for seed in 0..4 {
        let peers = Peers {
            silences_ns: Some((500 * MS, 40 * MS)),
            ..Peers::default()
        };
        assert_eq!(reason(&with(seed, peers, 1000.0)), None, "seed {seed}");
    }
}
