//! The recorder's side of the rings: hands the records of a run to the sink.
//!
//! One `Recorder` serves every driver: on its own thread in real time, between the ticks on the virtual clock. A round takes a bounded
//! number of records, then a bounded number of events, so that neither can starve the other. More events of one kind than
//! [`EVENTS_A_SECOND`] in a second of the run are counted and reported as one. A camera that doubles every frame does not fill the disk
//! with events.
//!
//! A sink that panics, that refuses for longer than [`REFUSED_NS`], that does not return from a call (`Pulse`), or whose disk has confirmed
//! nothing for [`Unconfirmed::LIMIT`] is a fault of the run ([`RecorderFault`]). The bead is frozen and the PZT parked, because a
//! measurement that nobody keeps is worth nothing. The rings are drained all the same and every record that found no taker is counted. A
//! slow disk is reported ([`Unconfirmed::SAID`]) and left to its work.

use crate::life::{Event, EventKind};
use crate::operator::Operator;
pub use crate::recording::{RecorderFault, RecorderReport, Unconfirmed};
use crate::run::RunSink;
use crate::summary::Statistics;
use crate::ticker::Feed;
use cellpos_rig::clock::monotonic_ns;
use std::mem::{Discriminant, discriminant};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

/// Events of one kind that are reported singly in a second of the run.
pub const EVENTS_A_SECOND: u64 = 20;
/// How long a sink may refuse before the run is taken for unrecorded, ns.
pub const REFUSED_NS: i64 = 500_000_000;

/// Most records in a round.
const RECORDS_A_ROUND: usize = 2048;
/// Most events in a round.
const EVENTS_A_ROUND: usize = 512;

/// Beats as long as the recorder returns from its calls.
#[derive(Debug, Default)]
pub(crate) struct Pulse {
    beats: AtomicU64,
    /// Rows that were handed over and are not among those that the disk has yet to confirm.
    kept: AtomicU64,
}

impl Pulse {
    fn beat(&self) {
        self.beats.fetch_add(1, Ordering::Release);
    }

    /// Rows that are known to be kept.
    pub(crate) fn kept(&self) -> u64 {
        self.kept.load(Ordering::Acquire)
    }
}

/// Watches the recorder's pulse from the control thread.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PulseWatch {
    seen: u64,
    looked_ns: Option<i64>,
    still_ns: i64,
}

impl PulseWatch {
    /// No beat for so long is a recorder that is stuck, ns.
    pub(crate) const STUCK_NS: i64 = 900_000_000;
    /// A look that comes later than this after the one before it says nothing about the time between, ns: the whole program, or the
    /// machine, may have stood still.
    const LOOK_NS: i64 = 10_000_000;

    /// Whether the recorder is stuck; to be asked in each tick.
    pub(crate) fn stuck(&mut self, pulse: &Pulse, now_ns: i64) -> bool {
        let beats = pulse.beats.load(Ordering::Acquire);
        let since_ns = now_ns - self.looked_ns.replace(now_ns).unwrap_or(now_ns);
        if beats == self.seen {
            self.still_ns = self.still_ns.saturating_add(since_ns.min(Self::LOOK_NS));
        } else {
            (self.seen, self.still_ns) = (beats, 0);
        }
        self.still_ns >= Self::STUCK_NS
    }

    /// For how long no beat has been seen, ns.
    pub(crate) fn still_ns(&self) -> i64 {
        self.still_ns
    }
}

/// Watches the data that the disk has not confirmed. Reports a slow disk, and its recovery after [`DiskWatch::CALM_NS`], so that a disk on
/// the edge is not reported every second.
#[derive(Debug, Clone, Copy, Default)]
struct DiskWatch {
    /// When it was last slow, and the longest since it was first told, ms.
    slow: Option<(i64, f64)>,
    longest: Duration,
}

impl DiskWatch {
    const CALM_NS: i64 = 10_000_000_000;

    fn look(&mut self, unconfirmed: Unconfirmed, now_ns: i64) -> Option<EventKind> {
        self.longest = self.longest.max(unconfirmed.since);
        let ms = unconfirmed.since.as_secs_f64() * 1e3;
        let is_slow = unconfirmed.since >= Unconfirmed::SAID;
        match &mut self.slow {
            Some((last_ns, longest_ms)) if is_slow => {
                (*last_ns, *longest_ms) = (now_ns, longest_ms.max(ms));
                None
            }
            Some((last_ns, longest_ms)) => {
                let longest_ms = *longest_ms;
                (now_ns - *last_ns >= Self::CALM_NS).then(|| {
                    self.slow = None;
                    EventKind::DiskSlowEnded { longest_ms }
                })
            }
            None => is_slow.then(|| {
                self.slow = Some((now_ns, ms));
                EventKind::DiskSlowStarted {
                    unconfirmed_ms: ms,
                    rows: unconfirmed.rows,
                    limit_ms: Unconfirmed::LIMIT.as_secs_f64() * 1e3,
                }
            }),
        }
    }
}

/// How often a kind of event came in the second that began last.
#[derive(Debug)]
struct Seen {
    kind: Discriminant<EventKind>,
    since_ns: i64,
    count: u64,
    /// The last event that was not reported singly.
    held: Option<Event>,
}

/// Tells equal events one by one up to a rate, and the rest by number.
#[derive(Debug, Default)]
struct Limiter {
    seen: Vec<Seen>,
}

impl Limiter {
    const SECOND_NS: i64 = 1_000_000_000;

    /// Tells an event, or holds it back.
    fn event(&mut self, event: &Event, sink: &mut impl RunSink) {
        let kind = discriminant(&event.kind);
        let Some(seen) = self.seen.iter_mut().find(|seen| seen.kind == kind) else {
            self.seen.push(Seen {
                kind,
                since_ns: event.time_ns,
                count: 1,
                held: None,
            });
            return sink.event(event);
        };
        if event.time_ns - seen.since_ns >= Self::SECOND_NS {
            seen.tell(sink);
            (seen.since_ns, seen.count) = (event.time_ns, 0);
        }
        seen.count += 1;
        if seen.count <= EVENTS_A_SECOND {
            sink.event(event);
        } else {
            seen.held = Some(*event);
        }
    }

    /// Reports the number of events that were held back for a second, or of all.
    fn overdue(&mut self, now_ns: Option<i64>, sink: &mut impl RunSink) {
        for seen in &mut self.seen {
            if now_ns.is_none_or(|now_ns| now_ns - seen.since_ns >= Self::SECOND_NS) {
                seen.tell(sink);
            }
        }
    }
}

impl Seen {
    fn tell(&mut self, sink: &mut impl RunSink) {
        if let Some(last) = self.held.take() {
            sink.repeated(&last, self.count - EVENTS_A_SECOND);
            self.count = EVENTS_A_SECOND;
        }
    }
}

/// Hands over what waits in the rings.
#[derive(Debug)]
pub(crate) struct Recorder<'a, S> {
    feed: Feed,
    sink: &'a mut S,
    statistics: &'a mut Statistics,
    pulse: &'a Pulse,
    limiter: Limiter,
    refused_since_ns: Option<i64>,
    disk: DiskWatch,
    report: RecorderReport,
    /// Number and time of the newest record, ns since the start of the run, and how many were taken.
    newest_seq: u64,
    newest_ns: i64,
    taken: u64,
    /// A record or event has been handed to the sink and was not yet taken.
    record_in_hand: bool,
    event_in_hand: bool,
}

impl<'a, S: RunSink> Recorder<'a, S> {
    pub(crate) fn new(
        feed: Feed,
        sink: &'a mut S,
        statistics: &'a mut Statistics,
        pulse: &'a Pulse,
    ) -> Self {
        Self {
            feed,
            sink,
            statistics,
            pulse,
            limiter: Limiter::default(),
            refused_since_ns: None,
            disk: DiskWatch::default(),
            report: RecorderReport::default(),
            newest_seq: 0,
            newest_ns: 0,
            taken: 0,
            record_in_hand: false,
            event_in_hand: false,
        }
    }

    /// What ended the recording, if anything did.
    pub(crate) fn fault(&self) -> Option<RecorderFault> {
        self.report.fault
    }

    /// Whether nobody will put anything into the rings any more.
    fn is_over(&self) -> bool {
        self.feed.records.is_abandoned() && self.feed.events.is_abandoned()
    }

    /// One round at a time of any steady clock; says whether more waits than a round takes.
    pub(crate) fn round(&mut self, now_ns: i64) -> bool {
        self.pulse.beat();
        if self.report.fault == Some(RecorderFault::Panicked) {
            return self.discard();
        }
        let taken = catch_unwind(AssertUnwindSafe(|| {
            let more = self.hand_over();
            self.look_at_the_disk(now_ns);
            more
        }));
        let Ok(more) = taken else {
            self.panicked();
            return true;
        };
        if self.sink.is_refused() {
            let since_ns = *self.refused_since_ns.get_or_insert(now_ns);
            if now_ns - since_ns >= REFUSED_NS {
                self.report.fault.get_or_insert(RecorderFault::Refused);
            }
        } else {
            self.refused_since_ns = None;
        }
        more
    }

    /// Unconfirmed data is reported while the disk may still confirm it, and is a fault when it does not.
    fn look_at_the_disk(&mut self, now_ns: i64) {
        let unconfirmed = self.sink.unconfirmed();
        let kept = self.taken.saturating_sub(unconfirmed.rows);
        self.pulse.kept.store(kept, Ordering::Release);
        if let Some(kind) = self.disk.look(unconfirmed, now_ns) {
            let event = Event {
                seq: self.newest_seq,
                time_ns: self.newest_ns,
                kind,
            };
            self.limiter.event(&event, self.sink);
        }
        if unconfirmed.since >= Unconfirmed::LIMIT {
            self.report.fault.get_or_insert(RecorderFault::Unconfirmed);
        }
    }

    fn panicked(&mut self) {
        self.report.fault = Some(RecorderFault::Panicked);
        self.report.records_unkept += u64::from(self.record_in_hand);
        self.report.events_unkept += u64::from(self.event_in_hand);
    }

    fn hand_over(&mut self) -> bool {
        let mut left = RECORDS_A_ROUND;
        while left > 0 && self.sink.is_ready() {
            let Ok(record) = self.feed.records.pop() else {
                break;
            };
            left -= 1;
            (self.newest_seq, self.newest_ns) = (record.seq, record.time_ns);
            self.taken += 1;
            self.statistics.add(&record);
            self.record_in_hand = true;
            self.sink.tick(&record);
            self.record_in_hand = false;
            self.pulse.beat();
        }
        let mut more = left == 0;
        left = EVENTS_A_ROUND;
        while left > 0 {
            let Ok(event) = self.feed.events.pop() else {
                break;
            };
            left -= 1;
            self.event_in_hand = true;
            self.limiter.event(&event, self.sink);
            self.event_in_hand = false;
            self.pulse.beat();
        }
        more |= left == 0;
        self.limiter.overdue(Some(self.newest_ns), self.sink);
        while let Ok((motion, state)) = self.feed.learned.pop() {
            self.sink.learned(motion, &state);
        }
        more
    }

    /// Counts what no sink takes any more.
    fn discard(&mut self) -> bool {
        while let Ok(record) = self.feed.records.pop() {
            self.statistics.add(&record);
            self.report.records_unkept += 1;
        }
        while self.feed.events.pop().is_ok() {
            self.report.events_unkept += 1;
        }
        while self.feed.learned.pop().is_ok() {}
        false
    }

    pub(crate) fn progress(&mut self) {
        if self.report.fault == Some(RecorderFault::Panicked) {
            return;
        }
        let told = catch_unwind(AssertUnwindSafe(|| self.sink.progress(self.statistics)));
        if told.is_err() {
            self.report.fault = Some(RecorderFault::Panicked);
        }
    }

    /// Takes everything that is left, whether the sink is ready or not, and says how it went.
    pub(crate) fn finish(mut self) -> RecorderReport {
        while let Ok(record) = self.feed.records.pop() {
            self.statistics.add(&record);
            self.taken += 1;
            self.pulse.beat();
            if self.report.fault == Some(RecorderFault::Panicked) {
                self.report.records_unkept += 1;
            } else if catch_unwind(AssertUnwindSafe(|| self.sink.tick(&record))).is_err() {
                self.record_in_hand = true;
                self.panicked();
            }
        }
        while self.round(0) {}
        if self.report.fault != Some(RecorderFault::Panicked)
            && catch_unwind(AssertUnwindSafe(|| self.limiter.overdue(None, self.sink))).is_err()
        {
            self.panicked();
        }
        self.progress();
        let longest_ms = self.disk.longest.as_millis();
        self.report.unconfirmed_ms = u64::try_from(longest_ms).unwrap_or(u64::MAX);
        self.report
    }
}

/// The recorder's thread: until the rings are closed and empty. A fault is told to the operator's end of the loop at once.
pub(crate) fn serve<S: RunSink>(
    feed: Feed,
    sink: &mut S,
    statistics: &mut Statistics,
    operator: &Operator,
    pulse: &Pulse,
) -> RecorderReport {
    const LOOK_EVERY: Duration = Duration::from_millis(5);
    const PROGRESS_EVERY_NS: i64 = 100_000_000;
    let mut recorder = Recorder::new(feed, sink, statistics, pulse);
    let mut told_ns = i64::MIN;
    loop {
        // Asked first: whatever was pushed before the rings were closed is still drained below.
        let over = recorder.is_over();
        let now_ns = monotonic_ns();
        let more = recorder.round(now_ns);
        if let Some(fault) = recorder.fault() {
            operator.unrecorded(fault);
        }
        if over && !more {
            return recorder.finish();
        }
        if now_ns.saturating_sub(told_ns) >= PROGRESS_EVERY_NS {
            told_ns = now_ns;
            recorder.progress();
        }
        if !more {
            thread::sleep(LOOK_EVERY);
        }
    }
}

#[cfg(test)]
#[path = "recorder_tests.rs"]
mod tests;
