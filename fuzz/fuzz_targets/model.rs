#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    stages::testing::hostile_models::model(bytes);
});
