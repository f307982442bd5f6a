//! A line with the behaviour of USB: moments in which it accepts nothing, and bytes in packets.

use super::args::StallOption;
use cellpos_numeric::Random;

/// A microframe of high-speed USB, ns: a packet each way.
const MICROFRAME_NS: i64 = 125_000;

/// The stalls of the line, and the size of its packets.
#[derive(Debug)]
pub(super) struct Usb {
    /// Start and end of the requested stalls, ns of the machine's clock.
    spans_ns: Vec<[i64; 2]>,
    random: Vec<RandomStalls>,
    chunk: Option<usize>,
    next_packet_ns: i64,
}

#[derive(Debug)]
struct RandomStalls {
    per_s: f64,
    longest_ms: f64,
    dice: Random,
    now_ns: [i64; 2],
}

impl RandomStalls {
    /// Shortest stall, ms.
    const SHORTEST_MS: f64 = 1.0;

    fn draw(&mut self, from_ns: i64) {
        let wait_s = -(1.0 - self.dice.uniform()).ln() / self.per_s;
        let ratio = (self.longest_ms / Self::SHORTEST_MS).max(1.0);
        let ms = Self::SHORTEST_MS * ratio.powf(self.dice.uniform());
        let from_ns = from_ns + (wait_s * 1e9) as i64;
        self.now_ns = [from_ns, from_ns + (ms * 1e6) as i64];
    }
}

impl Usb {
    /// Stalls that count from `start_ns`; `chunk`: most bytes of a packet.
    pub(super) fn new(
        stalls: &[StallOption],
        chunk: Option<usize>,
        seed: u64,
        start_ns: i64,
    ) -> Self {
        let mut this = Self {
            spans_ns: Vec::new(),
            random: Vec::new(),
            chunk,
            next_packet_ns: start_ns,
        };
        for (number, stall) in (40_u64..).zip(stalls) {
            match *stall {
                StallOption::Span(span) => {
                    let from_ns = start_ns + (span.at.value() * 1e9) as i64;
                    let for_s = span.length.map_or(f64::INFINITY, |length| length.value());
                    this.spans_ns
                        .push([from_ns, from_ns.saturating_add((for_s * 1e9) as i64)]);
                }
                StallOption::Random { rate, longest } => {
                    let mut random = RandomStalls {
                        per_s: rate.value(),
                        longest_ms: longest.value() * 1e3,
                        dice: Random::stream(seed, number),
                        now_ns: [i64::MAX; 2],
                    };
                    random.draw(start_ns);
                    this.random.push(random);
                }
            }
        }
        this
    }

    /// Whether the line is stalled at present.
    pub(super) fn is_stalled(&mut self, now_ns: i64) -> bool {
        let within = |[from_ns, until_ns]: &[i64; 2]| (*from_ns..*until_ns).contains(&now_ns);
        let mut stalled = self.spans_ns.iter().any(within);
        for random in &mut self.random {
            if now_ns >= random.now_ns[1] {
                random.draw(now_ns);
            }
            stalled |= within(&random.now_ns);
        }
        stalled
    }

    /// How many of `most` bytes may pass each way now.
    pub(super) fn packet(&mut self, most: usize, now_ns: i64) -> usize {
        let Some(chunk) = self.chunk else {
            return most;
        };
        if now_ns < self.next_packet_ns {
            return 0;
        }
        self.next_packet_ns = now_ns + MICROFRAME_NS;
        chunk.min(most)
    }

    /// Time of the line's next event, ns, at which the box must look.
    pub(super) fn next_event_ns(&self, now_ns: i64) -> i64 {
        let packet_ns = match self.chunk {
            Some(_) => self.next_packet_ns.max(now_ns),
            None => i64::MAX,
        };
        let ends = self.spans_ns.iter().flatten();
        let ends = ends.chain(self.random.iter().flat_map(|random| &random.now_ns));
        let ends = ends.copied().filter(|&ns| ns > now_ns);
        ends.min().unwrap_or(i64::MAX).min(packet_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stalls_are_as_often_and_as_long_as_asked_and_packets_are_small() {
        let stalls = ["2Hz,100ms", "5s,250ms"].map(|text| text.parse().unwrap());
        let mut usb = Usb::new(&stalls, Some(64), 1, 0);
        let stalled = |usb: &mut Usb, from_ms: i64, until_ms: i64| {
            let mut ms = from_ms..until_ms;
            ms.by_ref()
                .filter(|ms| usb.is_stalled(ms * 1_000_000))
                .count() as f64
        };
        // Two a second, of 21.5 ms in the mean of a logarithm that is uniform from 1 to 100 ms.
        let share = stalled(&mut usb, 10_000, 410_000) / 400_000.0;
        assert!((0.03..0.055).contains(&share), "{share}");
        let mut once = Usb::new(&stalls[1..], None, 1, 0);
        assert_eq!(stalled(&mut once, 0, 10_000), 250.0);
        assert_eq!(once.packet(4096, 0), 4096);
        assert_eq!((usb.packet(4096, 0), usb.packet(4096, 1000)), (64, 0));
        assert_eq!(usb.packet(40, 125_000), 40);
    }
}
