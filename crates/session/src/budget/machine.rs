//! The memory of the machine, and how freed memory gets back to the system.

use std::path::{Path, PathBuf};

/// Memory that is assumed if the machine's is unknown, bytes.
const UNKNOWN: u64 = 1 << 30;

/// Returns half of the machine's memory, or of the lowest limit of this process's control groups if that is less,
/// bytes. If neither is known, it returns half of 1 GiB.
pub fn half_of_the_machine() -> u64 {
    let machine =
        std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| total(&text)).or_else(told_by_the_system);
    let groups = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let limits = groups_of(&groups).into_iter().filter_map(|file| limit(&std::fs::read_to_string(file).ok()?));
    limits.chain(machine).min().unwrap_or(UNKNOWN) / 2
}

/// Returns the machine's memory from a system call, bytes, if /proc does not have it (`ProcSubset=pid` of a systemd
/// unit).
fn told_by_the_system() -> Option<u64> {
    #[cfg(target_os = "linux")]
    {
        let told = rustix::system::sysinfo();
        #[allow(clippy::useless_conversion)]
        let total = u64::from(told.totalram).checked_mul(u64::from(told.mem_unit))?;
        (total > 0).then_some(total)
    }
    #[cfg(not(target_os = "linux"))]
    {
        let mut system = sysinfo::System::new();
        system.refresh_memory();
        (system.total_memory() > 0).then(|| system.total_memory())
    }
}

/// Parses `MemTotal:  16324520 kB`. Returns bytes.
fn total(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? << 10)
}

/// Returns the files with the memory limits of the groups in `/proc/self/cgroup` and of those above them.
fn groups_of(text: &str) -> Vec<PathBuf> {
    let root = Path::new("/sys/fs/cgroup");
    let mut files = Vec::new();
    for line in text.lines() {
        let mut fields = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(group)) = (fields.next(), fields.next()) else { continue };
        let (root, names): (_, &[&str]) = match controllers {
            "" => (root.to_owned(), &["memory.max", "memory.high"]),
            "memory" => (root.join("memory"), &["memory.limit_in_bytes"]),
            _ => continue,
        };
        // In a container the group's own path may not exist, but its root does.
        let group = Path::new(group.trim_start_matches('/'));
        let above = group.ancestors().map(|group| root.join(group));
        files.extend(above.flat_map(|folder| names.iter().map(move |name| folder.join(name))));
    }
    files
}

/// Parses the limit of a group, bytes. A group without a limit has `max`, or the largest number of whole pages,
/// 9.2e18 bytes.
fn limit(text: &str) -> Option<u64> {
    const NO_MACHINE_HAS: u64 = 1 << 56;
    text.trim().parse().ok().filter(|bytes| *bytes < NO_MACHINE_HAS)
}

/// Size from which a block becomes a mapping of its own, bytes. Smaller ones would ask the system too often: a
/// mapping costs some µs, and a page fault for each 4 KiB.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const SEPARATE_BYTES: std::ffi::c_int = 256 << 10;

/// Returns memory to the system that has been freed and is still held by the allocator. It takes some milliseconds,
/// so a stepping thread must not call it. It does nothing without the GNU allocator.
#[allow(unsafe_code)]
pub fn give_back_to_the_system() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        // SAFETY: it takes a number, and may be called by any thread at any time (malloc_trim(3)).
        unsafe extern "C" {
            safe fn malloc_trim(pad: usize) -> std::ffi::c_int;
        }
        malloc_trim(0);
    }
}

/// Sets up the GNU allocator for a server that runs for long. Call it before threads are started. With another
/// allocator it does nothing.
///
/// Blocks of [`SEPARATE_BYTES`] and more become mappings of their own, which go back to the system when they are
/// freed. Without a fixed threshold the allocator raises it to the largest block that was freed, up to 32 MiB;
/// large blocks then lie among small ones in the heaps of threads, and the free space between them stays resident.
/// After 4 minutes of an overload test 15 MiB were in use and 104 MiB of the heaps free, of which `malloc_trim`
/// returned 6; after 15 minutes 102 MiB stayed resident.
///
/// If the address space of this process is limited (`ulimit -v`), all threads share one heap: each would otherwise
/// reserve 64 MiB or more of it, and the first request would end the process.
#[allow(unsafe_code)]
pub fn set_up_allocator() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        // SAFETY: it takes two numbers, and may be called by any thread at any time (mallopt(3)).
        unsafe extern "C" {
            safe fn mallopt(parameter: std::ffi::c_int, value: std::ffi::c_int) -> std::ffi::c_int;
        }
        const M_MMAP_THRESHOLD: std::ffi::c_int = -3;
        const M_ARENA_MAX: std::ffi::c_int = -8;
        mallopt(M_MMAP_THRESHOLD, SEPARATE_BYTES);
        if rustix::process::getrlimit(rustix::process::Resource::As).current.is_some() {
            mallopt(M_ARENA_MAX, 1);
        }
    }
}

/// Parses an amount of memory such as `512MiB`, `2 GiB` or `1048576` (KiB, MiB, GiB, TiB: powers of 1024). Returns
/// bytes.
///
/// # Errors
/// Returns a message if the text is not a whole number of bytes or of these units, is below 1 MiB, or is 2⁶⁴ bytes or
/// more.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, u32); 5] = [("KiB", 10), ("MiB", 20), ("GiB", 30), ("TiB", 40), ("", 0)];
    let number = UNITS.iter().find_map(|(unit, shift)| Some((text.strip_suffix(unit)?, *shift)));
    let bytes = number.and_then(|(number, shift)| number.trim().parse::<u64>().ok()?.checked_mul(1 << shift));
    let why = "must be a whole number of bytes, or of KiB, MiB, GiB or TiB, and 1MiB at least";
    bytes.filter(|bytes| *bytes >= 1 << 20).ok_or_else(|| why.to_owned())
}

/// Returns the number of cores that this process may use.
#[allow(clippy::cast_precision_loss)]
pub(super) fn cores() -> f64 {
    std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_read_as_people_write_them() {
        assert_eq!(parse_bytes("64MiB"), Ok(64 << 20));
        assert_eq!(parse_bytes("2 GiB"), Ok(2 << 30));
        assert_eq!(parse_bytes("1048576"), Ok(1 << 20));
        for wrong in ["", "MiB", "1000", "-1GiB", "99999999999TiB", "1.5GiB", "2GB"] {
            assert!(parse_bytes(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_machine_has_memory_and_groups_are_found() {
        assert!(half_of_the_machine() > 1 << 20);
        assert_eq!(limit("4294967296\n"), Some(4 << 30));
        assert_eq!((limit("max\n"), limit("9223372036854771712\n")), (None, None));
        #[cfg(target_os = "linux")]
        {
            let by_proc = total(&std::fs::read_to_string("/proc/meminfo").unwrap()).unwrap();
            assert_eq!(told_by_the_system(), Some(by_proc));
        }
        assert_eq!(total("MemFree: 1 kB\nMemTotal:       2048 kB\n"), Some(2 << 20));
        let files = groups_of("12:cpu,cpuacct:/x\n3:memory:/a\n0::/b/c\n");
        let told: Vec<_> = files.iter().map(|file| file.to_str().unwrap()).collect();
        let (v1, v2) = ("/sys/fs/cgroup/memory", "/sys/fs/cgroup");
        let expected = [
            format!("{v1}/a/memory.limit_in_bytes"),
            format!("{v1}/memory.limit_in_bytes"),
            format!("{v2}/b/c/memory.max"),
            format!("{v2}/b/c/memory.high"),
            format!("{v2}/b/memory.max"),
            format!("{v2}/b/memory.high"),
            format!("{v2}/memory.max"),
            format!("{v2}/memory.high"),
        ];
        assert_eq!(told, expected);
    }
}
