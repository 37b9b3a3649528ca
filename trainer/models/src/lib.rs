//! The published networks, their samplers, and the CPU kernels under them.
//!
//! Not its job: stages, stores, workers, and the source of the data.

pub mod device;
pub mod diffusion;
pub mod flat;
pub mod flow;
pub mod frequency;
pub mod kernels;
pub mod losses;
pub mod names;
pub mod networks;
pub mod optim;
pub mod quantizer;
pub mod resident;
pub mod tokens;

/// The instruction set of this process's kernels: ours, Burn's and those of `gemm` detect the same features. Another
/// instruction set rounds differently, so workers of one stage must agree on it.
pub fn instruction_set() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        if kernels::simd::has_wide() {
            return "avx512";
        }
        if std::arch::is_x86_feature_detected!("avx512f") {
            // Without the extensions that our kernels need: `gemm` uses its wide version and our kernels do not.
            return "avx512f";
        }
        if kernels::simd::has_middle() {
            return "avx2";
        }
        "sse2"
    }
    #[cfg(target_arch = "aarch64")]
    {
        "neon"
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    {
        std::env::consts::ARCH
    }
}
