//! Several simulated runs at once: `--parallel N` of the tables.

pub use cellpos_numeric::parallel::map;

/// Value of `--NAME VALUE` or `--NAME=VALUE` among the arguments of the program; `default` without it.
///
/// # Panics
/// A value that is no number: the table would be another than was asked for.
pub fn option(name: &str, default: u64) -> u64 {
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let given = match argument.strip_prefix(name) {
            Some("") => arguments.next(),
            Some(rest) => rest.strip_prefix('=').map(str::to_string),
            None => None,
        };
        if let Some(given) = given {
            return given
                .parse()
                .unwrap_or_else(|_| panic!("{name} {given}: not a whole number"));
        }
    }
    default
}

/// Threads that `--parallel` requests; 1 without it, all cores for 0.
pub fn threads() -> usize {
    cellpos_numeric::parallel::threads(usize::try_from(option("--parallel", 1)).unwrap_or(1))
}
