//! Order of sequence numbers that wrap around.

/// Relation of a sequence number to the last accepted one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Newer; `skipped` numbers are missing in between.
    Newer {
        /// Missing numbers.
        skipped: u32,
    },
    /// The same number again.
    Same,
    /// From before: reordered or replayed.
    Older,
}

/// Compares sequence numbers as points on a circle of 2^32: newer means less than half the circle ahead.
///
/// ```
/// use cellpos_link::{Order, order};
/// assert_eq!(order(u32::MAX, 1), Order::Newer { skipped: 1 });
/// assert_eq!(order(5, 4), Order::Older);
/// ```
pub const fn order(last: u32, next: u32) -> Order {
    match next.wrapping_sub(last) {
        0 => Order::Same,
        ahead if ahead < 1 << 31 => Order::Newer { skipped: ahead - 1 },
        _ => Order::Older,
    }
}
