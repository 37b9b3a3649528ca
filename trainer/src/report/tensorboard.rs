//! Event files that TensorBoard reads: records of protocol buffers with checksums.
//!
//! A record is the length of its data (`u64`), a checksum of the length, the data, and a checksum of the data; numbers
//! are little-endian. The data is an `Event` of TensorFlow's `event.proto`; a scalar needs four of its fields.

use std::io::{self, Write};

/// A file of scalars under construction.
#[derive(Debug)]
pub(crate) struct EventFile<W> {
    out: W,
}

impl<W: Write> EventFile<W> {
    /// Begins a file.
    pub(crate) fn new(out: W, wall_s: f64) -> io::Result<Self> {
        let mut file = Self { out };
        let mut event = Vec::new();
        put_double(&mut event, 1, wall_s);
        put_bytes(&mut event, 3, b"brain.Event:2");
        file.record(&event)?;
        Ok(file)
    }

    /// Adds a value; `wall_s` is its time in seconds since 1970.
    pub(crate) fn scalar(&mut self, tag: &str, step: u64, wall_s: f64, value: f64) -> io::Result<()> {
        let mut scalar = Vec::new();
        put_bytes(&mut scalar, 1, tag.as_bytes());
        put_float(&mut scalar, 2, value as f32);
        let mut summary = Vec::new();
        put_bytes(&mut summary, 1, &scalar);
        let mut event = Vec::new();
        put_double(&mut event, 1, wall_s);
        put_key(&mut event, 2, 0);
        put_varint(&mut event, step);
        put_bytes(&mut event, 5, &summary);
        self.record(&event)
    }

    /// Writes what is still in memory.
    pub(crate) fn finish(mut self) -> io::Result<W> {
        self.out.flush()?;
        Ok(self.out)
    }

    fn record(&mut self, data: &[u8]) -> io::Result<()> {
        let length = (data.len() as u64).to_le_bytes();
        self.out.write_all(&length)?;
        self.out.write_all(&checksum(&length).to_le_bytes())?;
        self.out.write_all(data)?;
        self.out.write_all(&checksum(data).to_le_bytes())
    }
}

fn put_varint(out: &mut Vec<u8>, mut number: u64) {
    while number >= 0x80 {
        out.push(number as u8 | 0x80);
        number >>= 7;
    }
    out.push(number as u8);
}

/// The number of a field and the form of its value.
fn put_key(out: &mut Vec<u8>, field: u64, form: u64) {
    put_varint(out, field << 3 | form);
}

fn put_double(out: &mut Vec<u8>, field: u64, value: f64) {
    put_key(out, field, 1);
    out.extend(value.to_le_bytes());
}

fn put_float(out: &mut Vec<u8>, field: u64, value: f32) {
    put_key(out, field, 5);
    out.extend(value.to_le_bytes());
}

fn put_bytes(out: &mut Vec<u8>, field: u64, bytes: &[u8]) {
    put_key(out, field, 2);
    put_varint(out, bytes.len() as u64);
    out.extend(bytes);
}

/// CRC-32C by bytes.
const TABLE: [u32; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let (mut sum, mut bit) = (byte as u32, 0);
        while bit < 8 {
            sum = if sum & 1 == 1 { sum >> 1 ^ 0x82f6_3b78 } else { sum >> 1 };
            bit += 1;
        }
        table[byte] = sum;
        byte += 1;
    }
    table
};

/// The masked CRC-32C of these files.
fn checksum(bytes: &[u8]) -> u32 {
    let sum = !bytes.iter().fold(!0u32, |sum, byte| TABLE[(sum as u8 ^ byte) as usize] ^ sum >> 8);
    sum.rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unmasked(sum: u32) -> u32 {
        sum.wrapping_sub(0xa282_ead8).rotate_left(15)
    }

    #[test]
    fn checksums_are_those_of_the_standard() {
        // RFC 3720, B.4.
        assert_eq!(unmasked(checksum(&[0; 32])), 0x8a91_36aa);
        assert_eq!(unmasked(checksum(&[0xff; 32])), 0x62a8_ab43);
        assert_eq!(unmasked(checksum(b"123456789")), 0xe306_9283);
    }

    #[test]
    fn a_file_is_a_version_and_a_record_for_each_value() {
        let mut file = EventFile::new(Vec::new(), 1.5).unwrap();
        file.scalar("loss", 300, 2.5, 0.25).unwrap();
        let bytes = file.finish().unwrap();
        let mut records = Vec::new();
        let mut rest = bytes.as_slice();
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            let sum = |at: usize| u32::from_le_bytes(rest[at..at + 4].try_into().unwrap());
            assert_eq!(sum(8), checksum(&rest[..8]));
            let data = &rest[12..12 + length];
            assert_eq!(sum(12 + length), checksum(data));
            records.push(data.to_vec());
            rest = &rest[16 + length..];
        }
        assert_eq!(records.len(), 2);
        assert_eq!(records[0], [&[9][..], &1.5f64.to_le_bytes(), &[0x1a, 13], b"brain.Event:2"].concat());
        let scalar = [&[0x0a, 4][..], b"loss", &[0x15], &0.25f32.to_le_bytes()].concat();
        let summary = [&[0x0a, scalar.len() as u8][..], &scalar].concat();
        let event = [&[9][..], &2.5f64.to_le_bytes(), &[0x10, 0xac, 2, 0x2a, summary.len() as u8], &summary].concat();
        assert_eq!(records[1], event);
    }
}
