//! The line to the board.

/// A byte port that never blocks for long.
pub trait Port: Send {
    /// Name, for messages.
    fn name(&self) -> &str;
    /// Writes as many of the bytes as the line takes now, and says how many: 0 when it takes none.
    ///
    /// # Errors
    /// The line is gone; a later call may find it again.
    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize>;
    /// Reads what is there, at most `buffer.len()` bytes; 0 when nothing is.
    ///
    /// # Errors
    /// The line is gone; a later call may find it again.
    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize>;
}

impl<P: Port + ?Sized> Port for Box<P> {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        (**self).write_some(bytes)
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        (**self).read_available(buffer)
    }
}
