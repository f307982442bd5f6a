//! Properties of the machine that spoil a 1 kHz loop, and the line to change for each.

use serde::Serialize;
use std::path::Path;

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Weight {
    /// As it should be.
    Good,
    /// May cost some microseconds, or spoil a run under other conditions.
    Note,
    /// Will cost ticks.
    Bad,
}

/// One property that was examined.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub what: &'static str,
    /// What was found.
    pub found: String,
    /// How bad it is.
    pub weight: Weight,
    /// The line to change; none if all is well or nothing can be done.
    pub change: Option<String>,
}

fn good(what: &'static str, found: impl Into<String>) -> Finding {
    Finding {
        what,
        found: found.into(),
        weight: Weight::Good,
        change: None,
    }
}

fn finding(
    what: &'static str,
    found: impl Into<String>,
    weight: Weight,
    change: impl Into<String>,
) -> Finding {
    Finding {
        what,
        found: found.into(),
        weight,
        change: Some(change.into()),
    }
}

/// The system files to read: below `/` on a machine, below a folder in a test.
pub(super) struct Machine<'p> {
    /// What stands for `/`.
    pub root: &'p Path,
    /// CPU that the control thread is pinned to.
    pub cpu: usize,
    /// CPUs that the program may use, counted before anything was pinned.
    pub cpus: usize,
}

/// Bytes on the disk for each second of a run at 1 kHz: the stream of ticks while it runs, and the Parquet file at its end.
pub(super) const BYTES_PER_S: f64 = 450e3;

impl Machine<'_> {
    fn read(&self, path: &str) -> Option<String> {
        std::fs::read_to_string(self.root.join(path.trim_start_matches('/')))
            .ok()
            .map(|text| text.trim().to_owned())
    }

    fn entries(&self, path: &str) -> Vec<std::path::PathBuf> {
        let mut found: Vec<_> = std::fs::read_dir(self.root.join(path.trim_start_matches('/')))
            .into_iter()
            .flatten()
            .flatten()
            .map(|entry| entry.path())
            .collect();
        found.sort();
        found
    }

    /// Looks at everything.
    pub(super) fn findings(&self) -> Vec<Finding> {
        let looked = [
            Some(self.count()),
            Some(self.isolation()),
            self.idle_states(),
            self.governor(),
            self.throttling(),
            self.hypervisor(),
            self.clock_source(),
            self.interrupts(),
            self.serial_latency(),
            self.swap(),
        ];
        looked.into_iter().flatten().collect()
    }

    fn count(&self) -> Finding {
        match self.cpus {
            0 | 1 => finding(
                "CPUs",
                "one CPU: camera, control and recording share it",
                Weight::Bad,
                "give the machine, or the process (taskset, cgroup cpuset), two CPUs or more",
            ),
            many => good("CPUs", format!("{many} for this program")),
        }
    }

    fn isolation(&self) -> Finding {
        let isolated = self
            .read("/sys/devices/system/cpu/isolated")
            .unwrap_or_default();
        if within(&isolated, self.cpu) {
            return good(
                "isolation",
                format!("CPU {} is isolated ({isolated})", self.cpu),
            );
        }
        let cpu = self.cpu;
        finding(
            "isolation",
            format!("CPU {cpu} of the control thread is shared with everything else"),
            Weight::Note,
            format!(
                "in /etc/default/grub: GRUB_CMDLINE_LINUX=\"isolcpus={cpu} nohz_full={cpu} rcu_nocbs={cpu} irqaffinity=0\", \
                 then update-grub and reboot"
            ),
        )
    }

    fn idle_states(&self) -> Option<Finding> {
        const WORST_US: u64 = 50;
        let folder = format!("/sys/devices/system/cpu/cpu{}/cpuidle", self.cpu);
        let deepest = self
            .entries(&folder)
            .iter()
            .filter_map(|state| {
                let read = |name: &str| {
                    std::fs::read_to_string(state.join(name))
                        .ok()
                        .map(|text| text.trim().to_owned())
                };
                let enabled = read("disable").is_none_or(|text| text == "0");
                let latency: u64 = read("latency")?.parse().ok()?;
                enabled.then(|| (latency, read("name").unwrap_or_default()))
            })
            .max()?;
        let (latency_us, name) = deepest;
        Some(if latency_us > WORST_US {
            finding(
                "idle states",
                format!("{name} takes {latency_us} us to wake from"),
                Weight::Note,
                format!(
                    "cpupower idle-set -D {WORST_US} (or processor.max_cstate=1 on the kernel's command line)"
                ),
            )
        } else {
            good(
                "idle states",
                format!("the deepest, {name}, wakes in {latency_us} us"),
            )
        })
    }

    fn governor(&self) -> Option<Finding> {
        let path = format!(
            "/sys/devices/system/cpu/cpu{}/cpufreq/scaling_governor",
            self.cpu
        );
        let governor = self.read(&path)?;
        Some(if governor == "performance" {
            good("frequency governor", governor)
        } else {
            finding(
                "frequency governor",
                governor,
                Weight::Note,
                "cpupower frequency-set -g performance",
            )
        })
    }

    fn throttling(&self) -> Option<Finding> {
        let runtime: i64 = self
            .read("/proc/sys/kernel/sched_rt_runtime_us")?
            .parse()
            .ok()?;
        let period: i64 = self
            .read("/proc/sys/kernel/sched_rt_period_us")?
            .parse()
            .ok()?;
        Some(if runtime < 0 || runtime >= period {
            good("real-time throttling", "off")
        } else {
            // The loop uses a few per cent. The limit stops a runaway program at real-time priority.
            finding(
                "real-time throttling",
                format!("on: real-time threads get {runtime} of every {period} us, all together"),
                Weight::Note,
                "in /etc/sysctl.d/60-cellpos.conf: kernel.sched_rt_runtime_us = -1 (only where other real-time programs run)",
            )
        })
    }

    fn hypervisor(&self) -> Option<Finding> {
        let text = self.read("/proc/cpuinfo")?;
        let flags = text
            .lines()
            .find(|line| line.starts_with("flags") || line.starts_with("Features"))?;
        Some(
            if flags.split_whitespace().any(|flag| flag == "hypervisor") {
                finding(
                    "virtual machine",
                    "yes: the host may stop all CPUs at any time; a program inside cannot notice or prevent it",
                    Weight::Bad,
                    "run on the machine itself",
                )
            } else {
                good("virtual machine", "no")
            },
        )
    }

    fn clock_source(&self) -> Option<Finding> {
        let source =
            self.read("/sys/devices/system/clocksource/clocksource0/current_clocksource")?;
        let fast = ["tsc", "arch_sys_counter", "kvm-clock"];
        Some(if fast.contains(&source.as_str()) {
            good("clock source", source)
        } else {
            finding(
                "clock source",
                format!("{source}: reading the time takes microseconds"),
                Weight::Note,
                "clocksource=tsc tsc=reliable on the kernel's command line, where the processor's counter is sound",
            )
        })
    }

    fn interrupts(&self) -> Option<Finding> {
        let all = self.entries("/proc/irq");
        let mut here = 0;
        let mut seen = 0;
        for irq in &all {
            if let Ok(list) = std::fs::read_to_string(irq.join("smp_affinity_list")) {
                seen += 1;
                here += usize::from(within(list.trim(), self.cpu));
            }
        }
        if seen == 0 {
            return None;
        }
        let cpu = self.cpu;
        Some(if here == 0 {
            good(
                "interrupts",
                format!("none of {seen} may come to CPU {cpu}"),
            )
        } else {
            finding(
                "interrupts",
                format!("{here} of {seen} may come to CPU {cpu}"),
                Weight::Note,
                "irqaffinity=0 on the kernel's command line; systemctl disable --now irqbalance",
            )
        })
    }

    fn serial_latency(&self) -> Option<Finding> {
        let timers: Vec<(String, u64)> = self
            .entries("/sys/bus/usb-serial/devices")
            .iter()
            .filter_map(|device| {
                let ms = std::fs::read_to_string(device.join("latency_timer")).ok()?;
                let name = device.file_name()?.to_string_lossy().into_owned();
                Some((name, ms.trim().parse().ok()?))
            })
            .collect();
        let (name, ms) = timers.iter().max_by_key(|(_, ms)| *ms)?;
        Some(if *ms > 1 {
            finding(
                "serial latency timer",
                format!("{name} holds bytes back for up to {ms} ms"),
                Weight::Bad,
                format!(
                    "echo 1 > /sys/bus/usb-serial/devices/{name}/latency_timer, for good with packaging/60-cellpos.rules in \
                     /etc/udev/rules.d"
                ),
            )
        } else {
            good("serial latency timer", format!("{ms} ms"))
        })
    }

    fn swap(&self) -> Option<Finding> {
        let swaps = self.read("/proc/swaps")?;
        Some(if swaps.lines().count() > 1 {
            finding(
                "swap",
                "on: other programs may wait for the disk",
                Weight::Note,
                "swapoff -a for the run (the loop's own memory is locked)",
            )
        } else {
            good("swap", "off")
        })
    }

    /// Whether the user may open the existing serial ports.
    pub(super) fn serial_ports(&self) -> Option<Finding> {
        let ports: Vec<std::path::PathBuf> = self
            .entries("/dev")
            .into_iter()
            .filter(|path| {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                name.starts_with("ttyUSB") || name.starts_with("ttyACM")
            })
            .collect();
        if ports.is_empty() {
            return None;
        }
        let access = rustix::fs::Access::READ_OK | rustix::fs::Access::WRITE_OK;
        let refused = ports
            .iter()
            .find(|port| rustix::fs::access(port.as_path(), access).is_err());
        Some(match refused {
            Some(port) => finding(
                "serial ports",
                format!("{} may not be opened", port.display()),
                Weight::Bad,
                "usermod -aG dialout $USER, then log in again",
            ),
            None => good("serial ports", format!("{} may be opened", ports.len())),
        })
    }
}

/// Room on the disk for a run of this length, below a folder.
pub(super) fn disk(folder: &Path, run_s: f64) -> Option<Finding> {
    let there = folder
        .ancestors()
        .find(|path| path.exists())
        .filter(|path| !path.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let stat = rustix::fs::statvfs(there).ok()?;
    let free = stat.f_bavail as f64 * stat.f_frsize as f64;
    let needed = run_s * BYTES_PER_S;
    let gigabytes = |bytes: f64| format!("{:.1} GB", bytes * 1e-9);
    let found = format!(
        "{} free in {}, {} for the run asked for",
        gigabytes(free),
        there.display(),
        gigabytes(needed)
    );
    Some(if free < 1.2 * needed {
        finding(
            "disk",
            found,
            Weight::Bad,
            "make room, or record elsewhere with --runs",
        )
    } else {
        good("disk", found)
    })
}

/// Whether a list of CPUs as the kernel writes it (`0,2-5`) names one.
fn within(list: &str, cpu: usize) -> bool {
    list.split(',').any(|part| {
        let mut ends = part.trim().splitn(2, '-').map(str::parse::<usize>);
        match (ends.next(), ends.next()) {
            (Some(Ok(only)), None) => only == cpu,
            (Some(Ok(low)), Some(Ok(high))) => (low..=high).contains(&cpu),
            _ => false,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_of_cpus_are_read_as_the_kernel_writes_them() {
        assert!(within("0,2-5", 4) && within("3", 3) && within("0-1", 1));
        assert!(!within("0,2-5", 1) && !within("", 0) && !within("(null)", 0));
    }

    #[test]
    fn each_finding_says_which_line_to_change_and_a_good_machine_has_none() {
        let folder = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = folder.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let bad = [
            ("sys/devices/system/cpu/isolated", "\n"),
            (
                "sys/devices/system/cpu/cpu3/cpuidle/state2/latency",
                "890\n",
            ),
            ("sys/devices/system/cpu/cpu3/cpuidle/state2/name", "C10\n"),
            (
                "sys/devices/system/cpu/cpu3/cpufreq/scaling_governor",
                "powersave\n",
            ),
            ("proc/sys/kernel/sched_rt_runtime_us", "950000\n"),
            ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
            (
                "proc/cpuinfo",
                "model name\t: X\nflags\t\t: fpu hypervisor\n",
            ),
            (
                "sys/devices/system/clocksource/clocksource0/current_clocksource",
                "hpet\n",
            ),
            ("proc/irq/17/smp_affinity_list", "0-3\n"),
            ("sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "16\n"),
            ("proc/swaps", "Filename Type\n/dev/sda2 partition\n"),
        ];
        for (path, text) in bad {
            write(path, text);
        }
        let machine = |cpus| Machine {
            root: folder.path(),
            cpu: 3,
            cpus,
        };
        let found = machine(1).findings();
        assert_eq!(found.len(), 10);
        for one in &found {
            assert!(
                one.weight != Weight::Good && one.change.is_some(),
                "{one:?}"
            );
        }
        let good = [
            ("sys/devices/system/cpu/isolated", "2-3\n"),
            ("sys/devices/system/cpu/cpu3/cpuidle/state2/latency", "10\n"),
            (
                "sys/devices/system/cpu/cpu3/cpufreq/scaling_governor",
                "performance\n",
            ),
            ("proc/sys/kernel/sched_rt_runtime_us", "-1\n"),
            ("proc/cpuinfo", "flags\t\t: fpu tsc\n"),
            (
                "sys/devices/system/clocksource/clocksource0/current_clocksource",
                "tsc\n",
            ),
            ("proc/irq/17/smp_affinity_list", "0-1\n"),
            ("sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "1\n"),
            ("proc/swaps", "Filename Type\n"),
        ];
        for (path, text) in good {
            write(path, text);
        }
        for one in machine(4).findings() {
            assert!(
                one.weight == Weight::Good && one.change.is_none(),
                "{one:?}"
            );
        }
        let full = disk(folder.path(), 1e12).unwrap();
        assert!(full.weight == Weight::Bad && full.found.contains("GB"));
    }
}
