//! Registers, vectors and start-up: all that is unsafe.
//!
//! Addresses and bits: ARM, Application Note AN386 and the CMSDK's technical reference manual.

use core::ptr::{read_volatile, write_volatile};

/// Reads a register.
fn get(address: usize) -> u32 {
    // SAFETY: only called with the addresses of registers below, which exist on this board and are word-aligned.
    unsafe { read_volatile(address as *const u32) }
}

/// Writes a register.
fn set(address: usize, value: u32) {
    // SAFETY: as for `get`.
    unsafe { write_volatile(address as *mut u32, value) }
}

/// A CMSDK UART.
pub struct Uart(usize);

impl Uart {
    const DATA: usize = 0x0;
    const STATE: usize = 0x4;
    const CONTROL: usize = 0x8;
    const DIVIDER: usize = 0x10;

    fn start(base: usize) -> Self {
        // 25 MHz / 25: 1 MBd.
        set(base + Self::DIVIDER, 25);
        set(base + Self::CONTROL, 0b11);
        Self(base)
    }

    /// The line to the host.
    pub fn line() -> Self {
        Self::start(0x4000_4000)
    }

    /// What stands for the converter.
    pub fn converter() -> Self {
        Self::start(0x4000_5000)
    }

    /// A byte that has arrived.
    pub fn take(&self) -> Option<u8> {
        (get(self.0 + Self::STATE) & 0b10 != 0).then(|| get(self.0 + Self::DATA) as u8)
    }

    /// Whether a byte can be handed over.
    pub fn has_room(&self) -> bool {
        get(self.0 + Self::STATE) & 0b01 == 0
    }

    /// Hands a byte over.
    pub fn give(&self, byte: u8) {
        set(self.0 + Self::DATA, u32::from(byte));
    }
}

/// Timer 0, counting down all 32 bits at 25 MHz: wraps every 171 s.
pub struct Counter(usize);

impl Counter {
    /// Cycles in a microsecond.
    pub const CYCLES_PER_US: u32 = 25;

    /// Starts it.
    pub fn start() -> Self {
        const BASE: usize = 0x4000_0000;
        set(BASE + 0x8, u32::MAX);
        set(BASE + 0x4, u32::MAX);
        set(BASE, 1);
        Self(BASE)
    }

    /// What it reads: fewer as time passes.
    pub fn cycles(&self) -> u32 {
        get(self.0 + 0x4)
    }
}

/// Some microseconds without an access to a device. QEMU serves accesses one at a time, under a lock that its serial ports need,
/// too. A firmware that polls without a pause starves its own line.
pub fn pause() {
    for _ in 0..500 {
        // SAFETY: does nothing.
        unsafe { core::arch::asm!("nop", options(nomem, nostack, preserves_flags)) }
    }
}

/// The LED in front of the camera: LED 0 of the FPGA's own registers.
pub struct Led(usize);

impl Led {
    /// It is dark after power-up.
    pub fn new() -> Self {
        Self(0x4002_8000)
    }

    /// Lit or dark.
    pub fn set(&self, lit: bool) {
        set(self.0, u32::from(lit));
    }
}

/// The CMSDK watchdog: resets the chip when it is not fed for a second.
pub struct Watchdog(usize);

impl Watchdog {
    /// Two time-outs of half a second: emulated time stalls with its host. A real board takes a few milliseconds.
    const CYCLES: u32 = 25_000_000 / 2;

    /// Starts it.
    pub fn start() -> Self {
        const BASE: usize = 0x4000_8000;
        set(BASE + 0xc00, 0x1acc_e551); // unlock
        set(BASE, Self::CYCLES);
        set(BASE + 0x8, 0b11); // count, and reset at the second time-out
        Self(BASE)
    }

    /// Restarts the time.
    pub fn feed(&self) {
        set(self.0 + 0xc, 1); // clears a time-out and reloads
    }
}

unsafe extern "C" {
    static mut data_start: u32;
    static mut data_end: u32;
    static data_load: u32;
    static mut bss_start: u32;
    static mut bss_end: u32;
    static stack_top: u32;
}

/// Stack pointer, reset, and the faults, which all end in a reset by the watchdog.
#[repr(C)]
struct Vectors {
    stack: *const u32,
    reset: unsafe extern "C" fn() -> !,
    faults: [unsafe extern "C" fn() -> !; 14],
}

// SAFETY: constant addresses, read by the core alone.
unsafe impl Sync for Vectors {}

#[unsafe(link_section = ".vectors")]
#[used]
static VECTORS: Vectors = Vectors {
    stack: &raw const stack_top,
    reset,
    faults: [fault; 14],
};

unsafe extern "C" fn fault() -> ! {
    loop {}
}

/// Sets up memory and runs.
#[unsafe(no_mangle)]
unsafe extern "C" fn reset() -> ! {
    // SAFETY: the linker script gives word-aligned bounds of memory that nothing uses yet.
    unsafe {
        let mut to = &raw mut data_start;
        let mut from = &raw const data_load;
        while to < &raw mut data_end {
            write_volatile(to, read_volatile(from));
            to = to.add(1);
            from = from.add(1);
        }
        let mut to = &raw mut bss_start;
        while to < &raw mut bss_end {
            write_volatile(to, 0);
            to = to.add(1);
        }
    }
    crate::main()
}
