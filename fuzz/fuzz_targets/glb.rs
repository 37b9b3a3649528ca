#![no_main]
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drop(hostile::targets::run("glb", bytes)));
