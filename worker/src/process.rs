//! Settings of the whole process, made before it has threads: allocator, process group, and death with the parent.

mod allocator;

pub use allocator::Allocator;

/// Keeps freed memory during a task instead of returning it to the kernel, which would map and zero it again for the next
/// tensor. Call it before any thread starts.
pub fn tune_allocator() {
    if allocator::is_mimalloc() {
        /// `mi_option_purge_delay`: the bindings name the options on both sides of it.
        const PURGE_DELAY: libmimalloc_sys::mi_option_t = libmimalloc_sys::mi_option_eager_commit_delay + 1;
        const _: () = assert!(PURGE_DELAY + 1 == libmimalloc_sys::mi_option_use_numa_nodes);
        /// Milliseconds. Without a limit, [`give_memory_back`] could not return anything either.
        const LONG: libc::c_long = 1_000_000_000;
        #[expect(unsafe_code, reason = "FFI; it takes two numbers and only changes the allocator's settings")]
        // SAFETY: the option exists, and the call is documented as safe while there is one thread.
        unsafe {
            libmimalloc_sys::mi_option_set(PURGE_DELAY, LONG);
        }
        return;
    }
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    set_allocator(&[
        // -1 is "never". The largest number is 2 GiB, and networks of 200 million parameters free more in every step.
        (libc::M_MMAP_THRESHOLD, -1),
        (libc::M_TRIM_THRESHOLD, -1),
        (libc::M_TOP_PAD, 256 << 20),
        (libc::M_ARENA_MAX, 1),
    ]);
}

/// Limits the arenas of a process that serves; call it before any thread starts. With glibc each thread gets an arena of
/// its own, which keeps the memory of its largest answer. After a short form of `benches/many.rs` the process had 244 MB,
/// with two arenas 123 MB.
pub fn tune_allocator_of_a_server() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    set_allocator(&[(libc::M_ARENA_MAX, 2)]);
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn set_allocator(settings: &[(libc::c_int, libc::c_int)]) {
    for (parameter, value) in settings {
        #[expect(unsafe_code, reason = "FFI; mallopt takes two numbers and only changes the allocator's settings")]
        let accepted = unsafe { libc::mallopt(*parameter, *value) };
        if accepted != 1 {
            tracing::debug!(parameter, "the allocator refused a setting");
        }
    }
}

/// Returns freed memory to the kernel between two tasks. A task that packed a dataset has held gigabytes, and the next
/// one may need none of them while other workers of the machine do.
pub(crate) fn give_memory_back() {
    if allocator::is_mimalloc() {
        #[expect(unsafe_code, reason = "FFI; mi_collect takes a flag and touches only what is free")]
        // SAFETY: it may be called at any time from any thread.
        unsafe {
            libmimalloc_sys::mi_collect(true);
        }
    }
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        #[expect(unsafe_code, reason = "FFI; malloc_trim takes a number and touches only what is free")]
        let released = unsafe { libc::malloc_trim(0) };
        tracing::debug!(released = released == 1, "memory between two tasks");
    }
}

/// Binds this process to its parent. It is killed when the parent dies. A Ctrl-C in the terminal does not reach it; the
/// parent turns that into an orderly end.
pub(crate) fn belong_to_parent() {
    #[cfg(target_os = "linux")]
    {
        use nix::sys::signal::Signal;

        let parent = nix::unistd::getppid();
        if let Err(error) = nix::sys::prctl::set_pdeathsig(Signal::SIGKILL) {
            tracing::warn!("cannot ask to be killed with the parent: {error}");
        }
        if nix::unistd::getppid() != parent {
            // The parent died in between.
            std::process::exit(1);
        }
    }
    #[cfg(unix)]
    if let Err(error) = nix::unistd::setpgid(nix::unistd::Pid::from_raw(0), nix::unistd::Pid::from_raw(0)) {
        tracing::warn!("cannot leave the terminal's process group: {error}");
    }
}

/// Resident memory of this process, in bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Memory {
    /// Without mapped files.
    pub(crate) anonymous: u64,
    pub(crate) resident: u64,
    /// The highest `resident` since the process started.
    pub(crate) peak: u64,
}

/// Memory of this process. `None` if the system does not report it.
pub(crate) fn memory() -> Option<Memory> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let field = |name: &str| {
        let value = status.lines().find_map(|line| line.strip_prefix(name))?;
        Some(value.trim().strip_suffix(" kB")?.parse::<u64>().ok()? << 10)
    };
    Some(Memory { anonymous: field("RssAnon:")?, resident: field("VmRSS:")?, peak: field("VmHWM:")? })
}

/// Memory of this machine or of this process's container in bytes. `None` if the system does not report it.
pub(crate) fn machine_memory() -> Option<u64> {
    let machine = std::fs::read_to_string("/proc/meminfo").ok()?;
    let machine = machine.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let machine = machine.trim().strip_suffix(" kB")?.parse::<u64>().ok()? << 10;
    let container = std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok().and_then(|text| text.trim().parse().ok());
    Some(container.map_or(machine, |container: u64| container.min(machine)))
}

/// The name of this machine; empty if the system does not report it.
pub(crate) fn host_name() -> String {
    std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default().trim().to_owned()
}

/// Default name of a worker: host and process id.
pub(crate) fn default_name() -> String {
    let host: String = host_name().chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').take(40).collect();
    let host = if host.starts_with(|c: char| c.is_ascii_alphanumeric()) { host } else { "worker".to_owned() };
    format!("{host}-{}", std::process::id())
}

/// Makes the calling thread the one that computes. Tensor kernels split their work over rayon's pool. If the pool has
/// only the calling thread, everything runs in place. `RAYON_NUM_THREADS` sets a larger pool.
pub fn compute_here() {
    let threads = std::env::var("RAYON_NUM_THREADS").ok().and_then(|n| n.parse::<usize>().ok()).filter(|n| *n > 0);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.unwrap_or(1)).use_current_thread().build_global();
    if let Err(error) = pool {
        tracing::warn!("the compute pool was started before the worker could size it: {error}");
    }
}
