#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    stage_lab::hostile::run("evaluator", bytes);
});
