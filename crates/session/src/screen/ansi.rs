//! Turns cells into the control sequences of a terminal.

use ratatui::backend::{Backend, ClearType, WindowSize};
use ratatui::buffer::Cell;
use ratatui::layout::{Position, Size};
use ratatui::style::{Color, Modifier};
use std::convert::Infallible;
use std::fmt::Write;

/// Collects sequences; its owner sends them. It cleans text, so that text from a file cannot control the terminal.
#[derive(Debug, Default)]
pub(super) struct Ansi {
    out: String,
    cursor: Position,
}

impl Ansi {
    /// What was drawn since.
    pub(super) fn take(&mut self) -> String {
        std::mem::take(&mut self.out)
    }

    fn say(&mut self, arguments: std::fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        let _ = self.out.write_fmt(arguments);
    }
}

fn colour(colour: Color, of: u8) -> String {
    match colour {
        Color::Black => format!("{of}0"),
        Color::Red => format!("{of}1"),
        Color::Green => format!("{of}2"),
        Color::Yellow => format!("{of}3"),
        Color::Blue => format!("{of}4"),
        Color::Magenta => format!("{of}5"),
        Color::Cyan => format!("{of}6"),
        Color::Gray | Color::White => format!("{of}7"),
        Color::Indexed(number) => format!("{of}8;5;{number}"),
        _ => format!("{of}9"),
    }
}

impl Backend for Ansi {
    type Error = Infallible;

    fn draw<'a, I>(&mut self, content: I) -> Result<(), Infallible>
    where
        I: Iterator<Item = (u16, u16, &'a Cell)>,
    {
        let mut at = None;
        for (x, y, cell) in content {
            if at != Some((x, y)) {
                self.say(format_args!("\x1b[{};{}H", y + 1, x + 1));
            }
            let bold = if cell.modifier.contains(Modifier::BOLD) {
                ";1"
            } else {
                ""
            };
            let (front, back) = (colour(cell.fg, 3), colour(cell.bg, 4));
            let symbol = cellpos_live::terminal::clean(
                cell.symbol(),
                cellpos_live::terminal::Colours::Removed,
            );
            let symbol = symbol.replace(['\n', '\t'], " ");
            self.say(format_args!("\x1b[0{bold};{front};{back}m{symbol}"));
            at = Some((x + 1, y));
        }
        self.say(format_args!("\x1b[0m"));
        Ok(())
    }

    fn hide_cursor(&mut self) -> Result<(), Infallible> {
        self.say(format_args!("\x1b[?25l"));
        Ok(())
    }

    fn show_cursor(&mut self) -> Result<(), Infallible> {
        self.say(format_args!("\x1b[?25h"));
        Ok(())
    }

    fn get_cursor_position(&mut self) -> Result<Position, Infallible> {
        Ok(self.cursor)
    }

    fn set_cursor_position<P: Into<Position>>(&mut self, position: P) -> Result<(), Infallible> {
        self.cursor = position.into();
        self.say(format_args!(
            "\x1b[{};{}H",
            self.cursor.y + 1,
            self.cursor.x + 1
        ));
        Ok(())
    }

    fn clear(&mut self) -> Result<(), Infallible> {
        self.say(format_args!("\x1b[0m\x1b[2J"));
        Ok(())
    }

    fn clear_region(&mut self, _: ClearType) -> Result<(), Infallible> {
        self.clear()
    }

    fn size(&self) -> Result<Size, Infallible> {
        let (columns, rows) = cellpos_live::terminal::size();
        Ok(Size::new(columns, rows))
    }

    fn window_size(&mut self) -> Result<WindowSize, Infallible> {
        Ok(WindowSize {
            columns_rows: self.size()?,
            pixels: Size::new(0, 0),
        })
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_side_by_side_need_one_place_and_orders_are_taken_out() {
        let mut ansi = Ansi::default();
        let mut cells = [Cell::default(), Cell::default()];
        cells[0].set_symbol("a").set_fg(Color::Red);
        cells[1].set_symbol("\u{1b}");
        let content = [(3, 1, &cells[0]), (4, 1, &cells[1])];
        ansi.draw(content.into_iter()).unwrap();
        let drawn = ansi.take();
        assert_eq!(drawn.matches('H').count(), 1, "{drawn:?}");
        assert!(drawn.starts_with("\x1b[2;4H\x1b[0;31;49ma"), "{drawn:?}");
        assert!(drawn.contains('\u{fffd}'), "{drawn:?}");
        assert_eq!(ansi.take(), "");
    }
}
