use super::*;
use crate::life::Request;
use crate::tick_record::TickRecord;
use crate::ticker::RingSizes;
use cellpos_control::LearnerState;
use cellpos_vision::FixQuality;
use rtrb::{Producer, RingBuffer};

/// The loop's end of the rings, as in a run.
struct Loop {
    records: Producer<TickRecord>,
    events: Producer<Event>,
    _learned: Producer<(u16, LearnerState)>,
}

fn rings(sizes: RingSizes) -> (Loop, Feed) {
    let (records, records_out) = RingBuffer::new(sizes.records);
    let (events, events_out) = RingBuffer::new(sizes.events);
    let (learned, learned_out) = RingBuffer::new(4);
    let feed = Feed {
        records: records_out,
        events: events_out,
        learned: learned_out,
    };
    let from = Loop {
        records,
        events,
        _learned: learned,
    };
    (from, feed)
}

impl Loop {
    fn tick(&mut self, seq: u64) {
        let record = TickRecord {
            seq,
            time_ns: seq as i64 * 1_000_000,
            verdict: FixQuality::Good as u8,
            ..TickRecord::unknown()
        };
        self.records.push(record).expect("room in the ring");
    }

    fn event(&mut self, seq: u64, kind: EventKind) {
        let event = Event {
            seq,
            time_ns: seq as i64 * 1_000_000,
            kind,
        };
        self.events.push(event).expect("room in the ring");
    }
}

/// The calls to a sink, in order.
#[derive(Debug, PartialEq)]
enum Call {
    Tick(u64),
    Event(u64),
    Repeated(u64, u64),
}

#[derive(Default)]
struct Sink {
    calls: Vec<Call>,
    panics_at: Option<u64>,
    refuses: bool,
}

impl RunSink for Sink {
    fn tick(&mut self, record: &TickRecord) {
        assert_ne!(Some(record.seq), self.panics_at, "a defect");
        self.calls.push(Call::Tick(record.seq));
    }
    fn event(&mut self, event: &Event) {
        self.calls.push(Call::Event(event.seq));
    }
    fn repeated(&mut self, last: &Event, count: u64) {
        self.calls.push(Call::Repeated(last.seq, count));
    }
    fn is_refused(&self) -> bool {
        self.refuses
    }
    fn progress(&mut self, _: &Statistics) {}
}

#[test]
fn a_round_is_bounded_and_takes_records_before_events() {
    let (mut from, feed) = rings(RingSizes::default());
    for seq in 0..5000 {
        from.tick(seq);
    }
    for seq in 0..5000 {
        from.event(seq, EventKind::FrameRepeated { frame_id: seq });
    }
    let (mut sink, mut statistics) = (Sink::default(), Statistics::default());
    let pulse = Pulse::default();
    let mut recorder = Recorder::new(feed, &mut sink, &mut statistics, &pulse);
    assert!(recorder.round(0));
    assert_eq!(recorder.sink.calls[0], Call::Tick(0));
    let ticks = |sink: &Sink| {
        let tick = |call: &&Call| matches!(call, Call::Tick(_));
        sink.calls.iter().filter(tick).count()
    };
    assert_eq!(ticks(recorder.sink), RECORDS_A_ROUND);
    assert!(recorder.sink.calls.len() <= RECORDS_A_ROUND + EVENTS_A_ROUND);
    recorder.finish();
    assert_eq!(ticks(&sink), 5000);
}

#[test]
fn equal_events_are_told_by_number_and_none_is_forgotten() {
    let (mut from, feed) = rings(RingSizes::default());
    for seq in 0..3000 {
        from.tick(seq);
        from.event(seq, EventKind::FrameRepeated { frame_id: seq });
    }
    from.event(3000, EventKind::Running);
    let (mut sink, mut statistics) = (Sink::default(), Statistics::default());
    Recorder::new(feed, &mut sink, &mut statistics, &Pulse::default()).finish();
    let mut events = 0;
    let mut lines = 0;
    for line in &sink.calls {
        match line {
            Call::Event(_) => (events, lines) = (events + 1, lines + 1),
            Call::Repeated(_, count) => (events, lines) = (events + count, lines + 1),
            Call::Tick(_) => {}
        }
    }
    assert_eq!(events, 3001);
    assert!(lines <= 3 * (EVENTS_A_SECOND + 1) + 1, "{lines} lines");
    // A rare event is reported singly, however often another kind comes.
    assert!(sink.calls.contains(&Call::Event(3000)));
    assert!(
        sink.calls
            .contains(&Call::Repeated(2999, 1000 - EVENTS_A_SECOND))
    );
}

#[test]
fn a_sink_that_panics_is_a_fault_and_every_record_after_it_is_counted() {
    let (mut from, feed) = rings(RingSizes::default());
    for seq in 0..100 {
        from.tick(seq);
    }
    let mut sink = Sink {
        panics_at: Some(40),
        ..Sink::default()
    };
    let mut statistics = Statistics::default();
    let pulse = Pulse::default();
    let mut recorder = Recorder::new(feed, &mut sink, &mut statistics, &pulse);
    let mut rounds = 0;
    while recorder.round(rounds) {
        rounds += 1;
    }
    assert_eq!(recorder.fault(), Some(RecorderFault::Panicked));
    for seq in 100..150 {
        from.tick(seq);
    }
    let report = recorder.finish();
    assert_eq!(report.records_unkept, 110);
    assert_eq!(sink.calls.len(), 40);
}

#[test]
fn a_sink_that_refuses_for_half_a_second_is_a_fault_and_a_short_refusal_is_none() {
    let (_from, feed) = rings(RingSizes::default());
    let (mut sink, mut statistics) = (Sink::default(), Statistics::default());
    let pulse = Pulse::default();
    let mut recorder = Recorder::new(feed, &mut sink, &mut statistics, &pulse);
    recorder.sink.refuses = true;
    recorder.round(0);
    recorder.round(REFUSED_NS - 1);
    recorder.sink.refuses = false;
    recorder.round(REFUSED_NS);
    recorder.sink.refuses = true;
    recorder.round(2 * REFUSED_NS);
    assert_eq!(recorder.fault(), None);
    recorder.round(3 * REFUSED_NS);
    assert_eq!(recorder.fault(), Some(RecorderFault::Refused));
}

#[test]
fn the_thread_ends_with_its_rings_and_tells_the_loop_what_it_died_of() {
    let (mut from, feed) = rings(RingSizes::default());
    for seq in 0..10 {
        from.tick(seq);
    }
    drop(from);
    let mut sink = Sink {
        panics_at: Some(3),
        ..Sink::default()
    };
    let operator = Operator::default();
    let report = serve(
        feed,
        &mut sink,
        &mut Statistics::default(),
        &operator,
        &Pulse::default(),
    );
    assert_eq!(report.records_unkept, 7);
    assert_eq!(operator.take(), Request::Unrecorded);
    operator.ask(Request::Park);
    assert_eq!(operator.take(), Request::Park, "parking is the stronger");
}
