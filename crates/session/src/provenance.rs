//! The provenance of a run: program, machine, devices.

use crate::Rig;
use cellpos_runtime::realtime::Conditions;

/// Version of the program.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
/// The newest commit at the time of the build; uncommitted changes are not in it.
pub const COMMIT: &str = env!("CELLPOS_COMMIT");
/// Both in a line.
pub const VERSION_AND_COMMIT: &str =
    concat!(env!("CARGO_PKG_VERSION"), " (", env!("CELLPOS_COMMIT"), ")");

/// The command line, word by word; bytes that are not text are shown as bytes.
pub fn command_line() -> Vec<String> {
    std::env::args_os()
        .map(|word| word.to_string_lossy().into_owned())
        .collect()
}

/// The command line as one text, the program without its folder.
pub fn command_text() -> String {
    command_line()
        .iter()
        .skip(1)
        .fold("cellpos".to_owned(), |line, word| line + " " + word)
}

fn first_line(path: &str) -> Option<String> {
    let text = std::fs::read_to_string(path).ok()?;
    let line = text.lines().next().unwrap_or("").trim().to_owned();
    (!line.is_empty()).then_some(line)
}

/// The machine's name, as the system has it.
pub fn host() -> String {
    first_line("/proc/sys/kernel/hostname").unwrap_or_else(|| "unknown".to_owned())
}

/// Machine and devices of a run: known before it begins.
pub fn machine(rig: &Rig) -> toml::Table {
    let mut table = toml::Table::new();
    let mut put = |key: &str, value: toml::Value| {
        table.insert(key.to_owned(), value);
    };
    put("host", host().into());
    let kernel = ["ostype", "osrelease", "version"]
        .map(|name| first_line(&format!("/proc/sys/kernel/{name}")).unwrap_or_default());
    put("kernel", kernel.join(" ").trim().into());
    let processor = std::fs::read_to_string("/proc/cpuinfo")
        .ok()
        .and_then(|text| {
            let line = text.lines().find(|line| line.starts_with("model name"))?;
            line.split_once(':').map(|(_, name)| name.trim().to_owned())
        });
    put(
        "processor",
        processor.unwrap_or_else(|| "unknown".to_owned()).into(),
    );
    let cpus = std::thread::available_parallelism().map_or(1, usize::from);
    put("cpus", (cpus as i64).into());
    let clock = "/sys/devices/system/clocksource/clocksource0/current_clocksource";
    put(
        "clock_source",
        first_line(clock)
            .unwrap_or_else(|| "unknown".to_owned())
            .into(),
    );
    let actuator = toml::Table::try_from(rig.actuator()).unwrap_or_default();
    put("actuator", toml::Value::Table(actuator));
    let source = rig.source();
    let mut camera = toml::Table::new();
    camera.insert("name".to_owned(), source.name.clone().into());
    camera.insert("rate_hz".to_owned(), source.rate_hz.into());
    camera.insert("width_px".to_owned(), (source.width_px as i64).into());
    camera.insert("height_px".to_owned(), (source.height_px as i64).into());
    put("camera", toml::Value::Table(camera));
    table
}

/// The rights that the operating system granted, known once the control thread runs.
pub fn granted(conditions: &Conditions) -> toml::Table {
    let mut table = toml::Table::new();
    let mut granted = toml::Table::try_from(conditions).unwrap_or_default();
    if conditions.policy == "virtual clock" {
        granted.retain(|key, _| key == "policy");
    }
    table.insert("real_time".to_owned(), toml::Value::Table(granted));
    table
}
