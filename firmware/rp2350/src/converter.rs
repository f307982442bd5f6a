//! The 16-bit converter on SPI 0, and the reading of its output.

use embassy_rp::Peri;
use embassy_rp::adc::{Adc, Channel, Config as AdcConfig};
use embassy_rp::gpio::{Level, Output, Pull};
use embassy_rp::peripherals::{ADC, PIN_17, PIN_18, PIN_19, PIN_26, SPI0};
use embassy_rp::spi::{Blocking, Config, Phase, Polarity, Spi};

/// Converters that this firmware can write.
#[derive(Clone, Copy, PartialEq, Eq)]
#[allow(dead_code, reason = "which one is soldered in is a constant")]
pub enum Part {
    /// Analog Devices AD5541A: 16 bits, taken over when chip select rises (LDAC at ground); code 0 after power-up.
    Ad5541a,
    /// Texas Instruments DAC8562, channel A: 8 bits of command and 16 of code (LDAC at ground); code 0 after power-up.
    Dac8562,
}

/// What is soldered in.
pub const PART: Part = Part::Ad5541a;

/// The output behind its amplifier, divided down to the ADC's 3.3 V, comes back on pin 26.
pub const LOOKED_AT: bool = true;
/// What the ADC (12 bits over 3.3 V) reads at the highest code: 10 V divided by four.
const COUNTS_AT_TOP: i32 = 3103;
/// How far the reading may be off: 2.5 % of the range, for dividers of 1 % and the ADC's own error.
const TOLERANCE: i32 = 78;
/// Readings in a row that must be wrong: 5 ms.
const READINGS: u8 = 50;

/// The pins.
pub struct Wires {
    pub spi: Peri<'static, SPI0>,
    pub select: Peri<'static, PIN_17>,
    pub clock: Peri<'static, PIN_18>,
    pub data: Peri<'static, PIN_19>,
    pub adc: Peri<'static, ADC>,
    pub looked_at: Peri<'static, PIN_26>,
}

/// The converter.
pub struct Converter {
    spi: Spi<'static, SPI0, Blocking>,
    select: Output<'static>,
    adc: Adc<'static, embassy_rp::adc::Blocking>,
    channel: Channel<'static>,
    /// Codes of this update and the one before.
    written: [u16; 2],
    wrong: u8,
}

impl Converter {
    /// Sets the pins up. Writes no code.
    pub fn new(wires: Wires) -> Self {
        let mut config = Config::default();
        config.frequency = 20_000_000;
        config.polarity = Polarity::IdleLow;
        config.phase = match PART {
            // Taken over by the rising edge, and by the falling one.
            Part::Ad5541a => Phase::CaptureOnFirstTransition,
            Part::Dac8562 => Phase::CaptureOnSecondTransition,
        };
        let spi = Spi::new_blocking_txonly(wires.spi, wires.clock, wires.data, config);
        let mut converter = Self {
            spi,
            select: Output::new(wires.select, Level::High),
            adc: Adc::new_blocking(wires.adc, AdcConfig::default()),
            channel: Channel::new_pin(wires.looked_at, Pull::None),
            written: [0; 2],
            wrong: 0,
        };
        if PART == Part::Dac8562 {
            // Its own reference on, gain 2: 0 to 5 V.
            converter.send(&[0x38, 0x00, 0x01]);
        }
        converter
    }

    fn send(&mut self, bytes: &[u8]) {
        self.select.set_low();
        // A blocking transfer of a few bytes has no way to fail.
        let _ = self.spi.blocking_write(bytes);
        let _ = self.spi.flush();
        self.select.set_high();
    }

    /// Writes a code: below 2 us.
    pub fn write(&mut self, code: u16) {
        let [high, low] = code.to_be_bytes();
        match PART {
            Part::Ad5541a => self.send(&[high, low]),
            // Write to channel A and take over.
            Part::Dac8562 => self.send(&[0x18, high, low]),
        }
        self.written = [code, self.written[0]];
    }

    /// Counts of the ADC, where the output is looked at.
    fn counts(&mut self) -> Option<i32> {
        if !LOOKED_AT {
            return None;
        }
        self.adc
            .blocking_read(&mut self.channel)
            .ok()
            .map(i32::from)
    }

    /// The code that the output shows by the ADC, good to some percent of the range.
    pub fn shown(&mut self) -> Option<u16> {
        let counts = self.counts()?.clamp(0, COUNTS_AT_TOP);
        u16::try_from(counts * 65_535 / COUNTS_AT_TOP).ok()
    }

    /// Whether the output has shown another code than those written last for 5 ms. To be called before each write.
    pub fn has_failed(&mut self) -> bool {
        let Some(counts) = self.counts() else {
            return false;
        };
        let expected = self
            .written
            .map(|code| i32::from(code) * COUNTS_AT_TOP / 65_535);
        let low = expected[0].min(expected[1]) - TOLERANCE;
        let high = expected[0].max(expected[1]) + TOLERANCE;
        self.wrong = if (low..=high).contains(&counts) {
            0
        } else {
            self.wrong.saturating_add(1)
        };
        self.wrong >= READINGS
    }
}
