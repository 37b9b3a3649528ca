//! The allocator of a program with several roles: mimalloc if it computes, the system's otherwise.
//!
//! Every operation of a training allocates buffers of up to megabytes. With the system's allocator trainings take some 5 %
//! more time (decision 0034). A server with mimalloc grew by more than the bytes of a checkpoint that it took in. Not its
//! job: the settings of the two allocators.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, Ordering};

use mimalloc::MiMalloc;

/// True in a process that computes. It is set before the first allocation, or never.
static COMPUTES: AtomicBool = AtomicBool::new(false);

/// mimalloc in a process whose first argument is `worker`, `join`, `generate`, `demo` or `time`, the system's allocator in
/// all others.
#[derive(Debug, Clone, Copy)]
pub struct Allocator;

/// Returns true if mimalloc is this process's allocator.
pub(super) fn is_mimalloc() -> bool {
    COMPUTES.load(Ordering::Relaxed)
}

#[expect(unsafe_code, reason = "an allocator hands out memory; each call is passed on as it is")]
// SAFETY: both allocators keep the contract, and all calls of a process go to the same one.
unsafe impl GlobalAlloc for Allocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as promised by the caller.
        unsafe { if is_mimalloc() { MiMalloc.alloc(layout) } else { System.alloc(layout) } }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as promised by the caller.
        unsafe { if is_mimalloc() { MiMalloc.alloc_zeroed(layout) } else { System.alloc_zeroed(layout) } }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as promised by the caller.
        unsafe { if is_mimalloc() { MiMalloc.dealloc(memory, layout) } else { System.dealloc(memory, layout) } }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as promised by the caller.
        unsafe {
            if is_mimalloc() { MiMalloc.realloc(memory, layout, size) } else { System.realloc(memory, layout, size) }
        }
    }
}

/// Returns true if a program with this first argument computes.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn computes(first: &std::ffi::CStr) -> bool {
    [c"worker", c"join", c"generate", c"demo", c"time"].contains(&first)
}

/// The C library passes the arguments to such functions before `main`, when nothing has been allocated yet. Others than
/// glibc do not, and keep the system's allocator.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod choice {
    use std::ffi::{CStr, c_char, c_int};
    use std::sync::atomic::Ordering;

    type Initialiser = extern "C" fn(c_int, *const *const c_char, *const *const c_char);

    #[used]
    #[expect(unsafe_code, reason = "a function that runs before `main` lies in this section")]
    #[unsafe(link_section = ".init_array")]
    static CHOOSE: Initialiser = choose;

    extern "C" fn choose(count: c_int, arguments: *const *const c_char, _: *const *const c_char) {
        if count < 2 || arguments.is_null() {
            return;
        }
        #[expect(unsafe_code, reason = "arguments of a program are pointers")]
        // SAFETY: there are `count` arguments, and each is a text that ends with a zero.
        let first = unsafe { CStr::from_ptr(*arguments.add(1)) };
        super::COMPUTES.store(super::computes(first), Ordering::Relaxed);
    }
}

#[cfg(all(test, target_os = "linux", target_env = "gnu"))]
mod tests {
    use super::computes;

    #[test]
    fn workers_and_samplers_compute_and_servers_do_not() {
        assert!([c"worker", c"join", c"generate", c"demo", c"time"].into_iter().all(computes));
        assert!(![c"serve", c"run", c"submit", c"registry", c"", c"workers"].into_iter().any(computes));
    }
}
