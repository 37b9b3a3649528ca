//! One byte string per JSON value: keys sorted, no white space. Digests of settings and manifests depend on it, so it
//! must not depend on the key order of a map type, which a feature flag of a dependency could change.

use serde::Serialize;
use serde_json::Value;

use crate::Digest;

/// Serialises `value` canonically.
///
/// # Panics
/// If `value` cannot be a JSON value (a map with keys that are not strings); none of our types is like that.
pub fn to_bytes<T: Serialize + ?Sized>(value: &T) -> Vec<u8> {
    let value = serde_json::to_value(value).expect("our types serialise to JSON");
    let mut out = Vec::new();
    write(&value, &mut out);
    out
}

/// Digest of the canonical bytes of `value`.
pub fn digest<T: Serialize + ?Sized>(value: &T) -> Digest {
    Digest::of(&to_bytes(value))
}

fn write(value: &Value, out: &mut Vec<u8>) {
    match value {
        Value::Object(map) => {
            let mut entries: Vec<_> = map.iter().collect();
            entries.sort_by(|a, b| a.0.cmp(b.0));
            out.push(b'{');
            for (i, (key, item)) in entries.into_iter().enumerate() {
                if i > 0 {
                    out.push(b',');
                }
                out.extend_from_slice(Value::String(key.clone()).to_string().as_bytes());
                out.push(b':');
                write(item, out);
            }
            out.push(b'}');
        }
        Value::Array(items) => {
            out.push(b'[');
            for (i, item) in items.iter().enumerate() {
                if i > 0 {
                    out.push(b',');
                }
                write(item, out);
            }
            out.push(b']');
        }
        leaf => out.extend_from_slice(leaf.to_string().as_bytes()),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn numbers_survive_being_read() {
        let mut state = 1_u32;
        for _ in 0..20_000 {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            let number = f64::from(f32::from_bits(state));
            if number.is_finite() {
                let bytes = to_bytes(&number);
                let read: Value = serde_json::from_slice(&bytes).expect("a number");
                assert_eq!(to_bytes(&read), bytes, "{number}");
            }
        }
    }

    #[test]
    fn key_order_does_not_matter() {
        let text = String::from_utf8(to_bytes(&json!({"b": [1, {"z": 1, "a": "x\"y"}], "a": 0.1}))).expect("utf-8");
        assert_eq!(text, r#"{"a":0.1,"b":[1,{"a":"x\"y","z":1}]}"#);
    }
}
