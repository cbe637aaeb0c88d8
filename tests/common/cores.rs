//! Cores of threads and programs, and the resources of a server. Linux only: times and memory are read from /proc.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::disallowed_methods)]

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Runs `work` with this thread, and what it starts, kept to the first core, or to all others.
pub fn kept_to<T>(first: bool, work: impl FnOnce() -> T) -> T {
    let all = sched_getaffinity(None).unwrap();
    let cores: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|core| all.is_set(*core)).collect();
    let mut some = CpuSet::new();
    cores.iter().enumerate().filter(|core| (core.0 == 0) == first).for_each(|core| some.set(*core.1));
    if some.count() > 0 {
        sched_setaffinity(None, &some).unwrap();
    }
    let result = work();
    sched_setaffinity(None, &all).unwrap();
    result
}

/// A line of /proc/PID/status, such as `VmRSS:` (KiB) or `Threads:`; 0 of a process that has ended.
fn status(process: u32, name: &str) -> u64 {
    let text = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix(name));
    line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

/// Resident memory, bytes.
pub fn resident(process: u32) -> u64 {
    status(process, "VmRSS:") * 1024
}

/// The most that was ever resident, bytes.
pub fn peak(process: u32) -> u64 {
    status(process, "VmHWM:") * 1024
}

/// Address space, bytes.
pub fn address_space(process: u32) -> u64 {
    status(process, "VmSize:") * 1024
}

pub fn threads(process: u32) -> u64 {
    status(process, "Threads:")
}

/// Open descriptors.
pub fn descriptors(process: u32) -> u64 {
    std::fs::read_dir(format!("/proc/{process}/fd")).map_or(0, |entries| entries.count() as u64)
}

/// Processor time of all threads so far, s: in ticks of 10 ms, on every Linux.
pub fn processor_s(process: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    let Some(end) = stat.rfind(')') else { return 0.0 };
    let ticks = stat[end + 1..].split_whitespace().skip(11).take(2);
    ticks.filter_map(|field| field.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// Time of a process's threads so far, s: by the beginning of their names, in user mode and in the system.
pub fn thread_times(process: u32) -> Vec<(String, [f64; 2])> {
    let mut times: Vec<(String, [f64; 2])> = Vec::new();
    for task in std::fs::read_dir(format!("/proc/{process}/task")).unwrap() {
        // A thread may have ended since.
        let Ok(stat) = std::fs::read_to_string(task.unwrap().path().join("stat")) else { continue };
        let (begin, end) = (stat.find('(').unwrap(), stat.rfind(')').unwrap());
        let name = stat[begin + 1..end].split('-').next().unwrap().to_owned();
        let ticks = stat[end + 2..].split_whitespace().skip(11).take(2).map(|field| field.parse::<f64>().unwrap());
        let seconds: Vec<f64> = ticks.map(|ticks| ticks / 100.0).collect();
        match times.iter_mut().find(|thread| thread.0 == name) {
            Some((_, sum)) => *sum = [sum[0] + seconds[0], sum[1] + seconds[1]],
            None => times.push((name, [seconds[0], seconds[1]])),
        }
    }
    times
}
