//! From the rings to every client, and the first messages for a new client.

use crate::feed::{FeedHub, Line};
use crate::queue::Queue;
use crate::row::{PICTURE_HEAD, ROW_BYTES, Row};
use crate::state::{ClipLine, CycleRow, EventLine, State};
use serde::Serialize;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tungstenite::{Bytes, Message};

/// First byte of a message of rows.
const ROWS: u8 = 1;
/// First byte of a picture.
const PICTURE: u8 = 2;
/// Past rows for a new client of a running run. A finished run sends as many as the page can hold.
const PAST_ROWS: usize = 10_000;
/// Time of a run that the page can hold, s, and its largest number of rows.
const HELD: (f64, usize) = (600.0, 1_200_000);
/// Most messages with past data for a new client: they must fit into its queue.
const PAST_MESSAGES: usize = 50;
/// Events kept for new clients.
const PAST_EVENTS: usize = 300;
/// Cycles kept for new clients.
const PAST_CYCLES: usize = 20_000;
/// Clips kept for new clients.
const PAST_CLIPS: usize = 1000;
/// Rows per message, few enough that a slow client loses little at a time.
const ROWS_OF_A_MESSAGE: usize = 2000;

/// Messages as JSON objects.
#[derive(Debug, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Update<'a> {
    State(&'a State),
    Events(Vec<&'a EventLine>),
    Cycles(Vec<&'a CycleRow>),
    Clips(Vec<&'a ClipLine>),
}

/// The hub's memory, and the queues of its clients.
#[derive(Debug)]
pub(crate) struct Hub {
    feed: FeedHub,
    clients: Clients,
    past: Past,
    past_rows: usize,
}

/// The clients, shared with the thread that accepts them. Locked by the server's own threads only.
#[derive(Debug, Clone, Default)]
pub(crate) struct Clients(Arc<Mutex<Vec<Arc<Queue>>>>);

#[derive(Debug, Default)]
struct Past {
    rows: VecDeque<Row>,
    events: VecDeque<EventLine>,
    cycles: VecDeque<CycleRow>,
    clips: VecDeque<ClipLine>,
    state: Option<State>,
}

impl Clients {
    fn lock(&self) -> MutexGuard<'_, Vec<Arc<Queue>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a client; it gets the past with the hub's next round.
    pub(crate) fn add(&self, queue: Arc<Queue>) {
        self.lock().push(queue);
    }

    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.lock()
            .iter()
            .filter(|queue| !queue.is_closed())
            .count()
    }
}

fn text(update: &Update<'_>) -> Message {
    // Plain data: it always serialises.
    Message::text(serde_json::to_string(update).unwrap_or_default())
}

fn rows_message<'a>(rows: impl ExactSizeIterator<Item = &'a Row>) -> Message {
    let mut bytes = Vec::with_capacity(8 + rows.len() * ROW_BYTES);
    bytes.extend([ROWS, 0, 0, 0]);
    bytes.extend((rows.len() as u32).to_le_bytes());
    for row in rows {
        row.encode(&mut bytes);
    }
    Message::Binary(Bytes::from(bytes))
}

impl Hub {
    pub(crate) fn new(feed: FeedHub, clients: Clients) -> Self {
        let past_rows = if feed.hello.recorded {
            ((HELD.0 * 1e6 / feed.hello.period_us) as usize).min(HELD.1)
        } else {
            PAST_ROWS
        };
        Self {
            feed,
            clients,
            past: Past::default(),
            past_rows,
        }
    }

    /// One round: sends everything that has come since the last one.
    pub(crate) fn round(&mut self) {
        let mut clients = self.clients.lock();
        clients.retain(|queue| !queue.is_closed());
        for queue in clients.iter().filter(|queue| queue.is_new()) {
            self.past.tell(queue);
        }
        let mut fresh = vec![];
        while let Ok(row) = self.feed.rows.pop() {
            fresh.push(row);
        }
        for chunk in fresh.chunks(ROWS_OF_A_MESSAGE) {
            let message = rows_message(chunk.iter());
            clients.iter().for_each(|queue| queue.push(&message));
        }
        self.past.rows.extend(fresh);
        let excess = self.past.rows.len().saturating_sub(self.past_rows);
        self.past.rows.drain(..excess);
        while let Ok(line) = self.feed.lines.pop() {
            let message = self.past.take(line);
            clients.iter().for_each(|queue| queue.push(&message));
        }
        let mut newest = None;
        while let Ok(picture) = self.feed.filled.pop() {
            if picture.is_sound() {
                let mut bytes = Vec::with_capacity(4 + PICTURE_HEAD + picture.pixels.len());
                bytes.extend([PICTURE, 0, 0, 0]);
                picture.encode(&mut bytes);
                newest = Some(Message::Binary(Bytes::from(bytes)));
            }
            // It came out of this ring.
            let _ = self.feed.empty.push(picture);
        }
        if let Some(message) = newest {
            clients.iter().for_each(|queue| queue.push(&message));
        }
    }
}

impl Past {
    /// Keeps a line, and returns its message.
    fn take(&mut self, line: Line) -> Message {
        match line {
            Line::State(state) => {
                let state = self.state.insert(*state);
                text(&Update::State(state))
            }
            Line::Event(event) => {
                let message = text(&Update::Events(vec![&event]));
                keep(&mut self.events, event, PAST_EVENTS);
                message
            }
            Line::Cycle(cycle) => {
                let message = text(&Update::Cycles(vec![&cycle]));
                keep(&mut self.cycles, cycle, PAST_CYCLES);
                message
            }
            Line::Clip(clip) => {
                let message = text(&Update::Clips(vec![&clip]));
                keep(&mut self.clips, clip, PAST_CLIPS);
                message
            }
        }
    }

    /// Sends a new client all kept data.
    fn tell(&self, queue: &Queue) {
        if let Some(state) = &self.state {
            queue.push(&text(&Update::State(state)));
        }
        if !self.events.is_empty() {
            queue.push(&text(&Update::Events(self.events.iter().collect())));
        }
        if !self.cycles.is_empty() {
            queue.push(&text(&Update::Cycles(self.cycles.iter().collect())));
        }
        if !self.clips.is_empty() {
            queue.push(&text(&Update::Clips(self.clips.iter().collect())));
        }
        let mut rows = self.rows.iter();
        let size = rows.len().div_ceil(PAST_MESSAGES).max(ROWS_OF_A_MESSAGE);
        while rows.len() > 0 {
            queue.push(&rows_message(rows.by_ref().take(size)));
        }
    }
}

fn keep<T>(kept: &mut VecDeque<T>, item: T, most: usize) {
    if kept.len() == most {
        kept.pop_front();
    }
    kept.push_back(item);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::feed::Feed;
    use crate::state::Hello;

    fn row(seq: u32) -> Row {
        Row {
            seq,
            ..Row::default()
        }
    }

    #[test]
    fn a_new_client_gets_the_past_once_and_then_what_comes() {
        let (mut feed, end) = Feed::new(Hello::default());
        let clients = Clients::default();
        let mut hub = Hub::new(end, clients.clone());
        feed.row(&row(1));
        feed.state(State::default());
        hub.round();
        let queue = Arc::new(Queue::default());
        clients.add(Arc::clone(&queue));
        feed.row(&row(2));
        hub.round();
        let got = queue.take();
        assert_eq!(got.len(), 3, "state, past rows, new rows");
        assert_eq!(got[1].len(), 8 + ROW_BYTES);
        hub.round();
        assert!(queue.take().is_empty());
    }

    #[test]
    fn a_client_that_takes_nothing_costs_a_bounded_memory() {
        let (mut feed, end) = Feed::new(Hello::default());
        let clients = Clients::default();
        let mut hub = Hub::new(end, clients.clone());
        let queue = Arc::new(Queue::default());
        clients.add(Arc::clone(&queue));
        for n in 0..20_000_u32 {
            feed.row(&row(n));
            hub.round();
        }
        assert!(queue.lost() > 19_000);
        assert!(queue.take().len() < 200);
        queue.close();
        hub.round();
        assert_eq!(clients.count(), 0);
    }
}
