#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    stages::testing::hostile::run("vocabulary", bytes);
});
