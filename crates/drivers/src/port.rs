//! The line to the board.

/// A byte port that never blocks for long.
pub trait Port: Send {
    /// Name, for messages.
    fn name(&self) -> &str;
    /// Writes as many bytes as the line accepts now, and returns their number, which may be 0.
    ///
    /// # Errors
    /// The line is gone; a later call may find it again.
    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize>;
    /// Reads the bytes that have arrived, at most `buffer.len()`; 0 if there are none.
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
