//! The models of `trainer demo` in one small file: weights with half their bytes, and what two models share once.
//!
//! ```text
//! zstd of: header length (4 bytes, little-endian), header (JSON), then every file in the header's order
//! ```
//!
//! Matrices in `.safetensors` files are rounded to bfloat16. Their upper bytes precede their lower bytes, which
//! compresses better. Vectors, such as means and biases, stay exact. Rounded models are other models: packing computes
//! their digests anew, in every manifest that names them. Unpacking gives valid bundles in single precision.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use anyhow::{Context as _, Result, bail, ensure};
use protocol::{Digest, Manifest};
use registry::bundle::{Head, Writer};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Level of the compression; packing is done once.
const LEVEL: i32 = 19;
/// Largest size of an unpacked file.
const LARGEST: u64 = 64 << 20;
/// Suffix of files with weights.
const WEIGHTS: &str = ".safetensors";

/// A model with its description.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Packed {
    pub(crate) head: Head,
    pub(crate) manifest: Manifest,
}

#[derive(Debug, Serialize, Deserialize)]
struct Header {
    models: Vec<Packed>,
    files: Vec<Entry>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Entry {
    digest: Digest,
    bytes: u64,
    /// True if its matrices are rounded.
    halved: bool,
}

/// An unpacked file of models.
#[derive(Debug)]
pub(crate) struct Pack {
    pub(crate) models: Vec<Packed>,
    files: BTreeMap<Digest, Vec<u8>>,
}

impl Pack {
    /// Rounds `models`, whose files `read` returns.
    pub(crate) fn of(models: Vec<Packed>, read: &dyn Fn(Digest) -> Result<Vec<u8>>) -> Result<Self> {
        let mut files = BTreeMap::new();
        let mut manifests = BTreeMap::new();
        let mut renamed = BTreeMap::new();
        for (name, entry) in models.iter().flat_map(|model| &model.manifest.files) {
            let mut bytes = read(entry.digest)?;
            if name.ends_with(WEIGHTS) {
                round(&mut bytes).with_context(|| format!("cannot round `{name}`"))?;
            } else if name.ends_with("manifest.json") {
                manifests.insert(entry.digest, String::from_utf8(bytes)?);
                continue;
            }
            let digest = Digest::of(&bytes);
            renamed.insert(entry.digest, digest);
            files.insert(digest, bytes);
        }
        // A manifest may name another one (`fits`), so names are replaced until nothing changes.
        loop {
            let before = renamed.clone();
            for (old, text) in &manifests {
                renamed.insert(*old, Digest::of(with_names(text, &before).as_bytes()));
            }
            if renamed == before {
                break;
            }
        }
        for (old, text) in &manifests {
            files.insert(renamed[old], with_names(text, &renamed).into_bytes());
        }
        let models = models.into_iter().map(|Packed { mut head, manifest }| {
            let text = String::from_utf8(manifest.to_bytes())?;
            let manifest: Manifest = serde_json::from_str(&with_names(&text, &renamed))?;
            head.artifact = manifest.digest();
            Ok(Packed { head, manifest })
        });
        Ok(Self { models: models.collect::<Result<_>>()?, files })
    }

    /// Serialises and compresses.
    pub(crate) fn to_bytes(&self) -> Result<Vec<u8>> {
        let mut entries = Vec::new();
        let mut bodies = Vec::new();
        let names = self.models.iter().flat_map(|model| &model.manifest.files);
        let names: BTreeMap<Digest, &String> = names.map(|(name, entry)| (entry.digest, name)).collect();
        for (digest, bytes) in &self.files {
            let halved = names.get(digest).is_some_and(|name| name.ends_with(WEIGHTS));
            entries.push(Entry { digest: *digest, bytes: bytes.len() as u64, halved });
            if halved {
                let layout = Layout::of(bytes)?;
                bodies.extend_from_slice(&bytes[..layout.begin]);
                layout.exact.iter().for_each(|span| bodies.extend_from_slice(&bytes[span.clone()]));
                for byte in [3, 2] {
                    bodies.extend(layout.matrices(bytes).map(|number| number[byte]));
                }
            } else {
                bodies.extend_from_slice(bytes);
            }
        }
        let header = serde_json::to_vec(&Header { models: self.models.clone(), files: entries })?;
        let whole = [&u32::try_from(header.len())?.to_le_bytes()[..], &header, &bodies].concat();
        Ok(zstd::encode_all(&whole[..], LEVEL)?)
    }

    /// Reads what [`to_bytes`](Self::to_bytes) wrote.
    pub(crate) fn read(bytes: &[u8]) -> Result<Self> {
        let whole = zstd::decode_all(bytes)?;
        let mut rest = Rest(&whole);
        let length = u32::from_le_bytes(rest.take(4)?.try_into()?);
        let Header { models, files: entries } = serde_json::from_slice(rest.take(length as usize)?)?;
        let mut files = BTreeMap::new();
        for Entry { digest, bytes, halved } in entries {
            ensure!(bytes <= LARGEST, "a file has {bytes} bytes");
            let bytes = usize::try_from(bytes)?;
            let file = if halved { rest.take_weights(bytes)? } else { rest.take(bytes)?.to_vec() };
            ensure!(Digest::of(&file) == digest, "a file does not have its digest {digest}");
            files.insert(digest, file);
        }
        Ok(Self { models, files })
    }

    /// Writes a model as a bundle.
    pub(crate) fn write_bundle(&self, model: &Packed, path: &Path) -> Result<()> {
        let Packed { head, manifest } = model;
        let card = format!("# {}\n\nA model of `trainer demo`, trained on procedural motion.\n", head.model);
        let mut writer = Writer::begin(BufWriter::new(File::create(path)?), head, manifest, &card)?;
        for (name, entry) in &manifest.files {
            let bytes = self.files.get(&entry.digest).with_context(|| format!("the file `{name}` is missing"))?;
            writer.file(name, entry.bytes)?;
            writer.write(bytes)?;
        }
        writer.finish()?.flush()?;
        Ok(())
    }
}

/// Replaces digests in the text of a manifest.
fn with_names(text: &str, renamed: &BTreeMap<Digest, Digest>) -> String {
    renamed.iter().fold(text.to_owned(), |text, (old, new)| text.replace(&old.hex(), &new.hex()))
}

/// The places of the tensors in a `.safetensors` file.
struct Layout {
    /// Offset of the first tensor.
    begin: usize,
    /// Bytes of the tensors with fewer than two dimensions.
    exact: Vec<std::ops::Range<usize>>,
    /// Bytes of the others.
    halved: Vec<std::ops::Range<usize>>,
}

impl Layout {
    /// Reads the header of a file; all tensors must be `F32`.
    fn of(file: &[u8]) -> Result<Self> {
        let length = u64::from_le_bytes(file.get(..8).context("it has no header")?.try_into()?);
        let begin = 8 + usize::try_from(length)?;
        let header: BTreeMap<String, Value> = serde_json::from_slice(file.get(8..begin).context("its header is cut")?)?;
        let mut layout = Self { begin, exact: Vec::new(), halved: Vec::new() };
        for (name, tensor) in header.iter().filter(|(name, _)| *name != "__metadata__") {
            ensure!(tensor["dtype"] == "F32", "tensor `{name}` is not F32");
            let offset = |i: usize| tensor["data_offsets"][i].as_u64().and_then(|at| usize::try_from(at).ok());
            let (Some(from), Some(to)) = (offset(0), offset(1)) else { bail!("tensor `{name}` has no place") };
            let dimensions = tensor["shape"].as_array().map_or(0, Vec::len);
            let spans = if dimensions < 2 { &mut layout.exact } else { &mut layout.halved };
            spans.push(begin + from..begin + to);
        }
        Ok(layout)
    }

    /// The numbers of the matrices, four bytes each.
    fn matrices<'f>(&self, file: &'f [u8]) -> impl Iterator<Item = &'f [u8]> {
        self.halved.iter().flat_map(|span| file[span.clone()].chunks_exact(4))
    }
}

/// Rounds the matrices of a file to the nearest bfloat16.
fn round(file: &mut [u8]) -> Result<()> {
    for span in Layout::of(file)?.halved {
        for number in file[span].chunks_exact_mut(4) {
            let bits = u32::from_le_bytes(number.try_into()?);
            // To nearest, and to even between two.
            let rounded = bits.wrapping_add(0x7fff + (bits >> 16 & 1)) & 0xffff_0000;
            number.copy_from_slice(&rounded.to_le_bytes());
        }
    }
    Ok(())
}

/// The bytes that are not read yet.
struct Rest<'b>(&'b [u8]);

impl<'b> Rest<'b> {
    fn take(&mut self, bytes: usize) -> Result<&'b [u8]> {
        let (taken, rest) = self.0.split_at_checked(bytes).context("it is cut")?;
        self.0 = rest;
        Ok(taken)
    }

    /// Takes a file of `bytes` bytes with rounded matrices.
    fn take_weights(&mut self, bytes: usize) -> Result<Vec<u8>> {
        let length = self.0.get(..8).context("it is cut")?;
        let begin = 8 + usize::try_from(u64::from_le_bytes(length.try_into()?))?;
        let mut file = self.take(begin)?.to_vec();
        let layout = Layout::of(&file)?;
        ensure!(begin <= bytes, "a file has a wrong length");
        file.resize(bytes, 0);
        for span in &layout.exact {
            let taken = self.take(span.len())?;
            file.get_mut(span.clone()).context("a tensor lies behind its file")?.copy_from_slice(taken);
        }
        for byte in [3, 2] {
            for span in &layout.halved {
                let taken = self.take(span.len() / 4)?;
                let numbers = file.get_mut(span.clone()).context("a tensor lies behind its file")?;
                numbers.chunks_exact_mut(4).zip(taken).for_each(|(number, half)| number[byte] = *half);
            }
        }
        Ok(file)
    }
}

#[cfg(test)]
mod tests {
    use checkpoint::model::{Model, assemble};
    use protocol::ArtifactKind;
    use protocol::artifact::{FileEntry, Role};
    use protocol::stage::DataFormat;
    use serde_json::json;

    use super::*;

    /// A `.safetensors` file with a matrix `[2, 3]` and a vector `[2]`.
    fn weights(values: [f32; 8]) -> Vec<u8> {
        let header = json!({
            "a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]},
            "b": {"dtype": "F32", "shape": [2], "data_offsets": [24, 32]},
        })
        .to_string();
        let numbers = values.into_iter().flat_map(f32::to_le_bytes);
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &numbers.collect::<Vec<u8>>()].concat()
    }

    /// A part with one file of weights.
    fn part(kind: ArtifactKind, meta: Value, file: &[u8]) -> Manifest {
        let mut part = Manifest::new(kind, meta);
        let entry = FileEntry::of_blob(Digest::of(file), file.len() as u64);
        part.files.insert("model.safetensors".into(), entry);
        part
    }

    #[test]
    fn a_pack_gives_valid_bundles_of_rounded_weights() {
        let numbers = [1.0, -0.1, 1e-20, 3.592_704, -2.5e8, 0.0, 0.1, -0.3];
        let (of_vae, of_denoiser) = (weights(numbers), weights(numbers.map(|number| number * 7.0)));
        let vae = part(ArtifactKind::Vae, json!({}), &of_vae);
        let denoiser = part(ArtifactKind::Denoiser, json!({"fits": {"vae": vae.digest()}}), &of_denoiser);
        let parts = BTreeMap::from([(Role::VAE, vae.clone()), (Role::DENOISER, denoiser.clone())]);
        let manifest = assemble("latent-diffusion", DataFormat::Humanml3d, &parts).unwrap();
        let kept = [vae.to_bytes(), denoiser.to_bytes(), of_vae.clone(), of_denoiser];
        let kept: BTreeMap<Digest, Vec<u8>> = kept.into_iter().map(|bytes| (Digest::of(&bytes), bytes)).collect();
        let head = Head {
            format: registry::bundle::FORMAT,
            model: "demo".parse().unwrap(),
            version: 1,
            artifact: manifest.digest(),
            metrics: BTreeMap::from([("recognised".to_owned(), Some(0.5))]),
            source: json!({}),
        };
        let packed = Pack::of(vec![Packed { head, manifest }], &|digest| Ok(kept[&digest].clone())).unwrap();
        let read = Pack::read(&packed.to_bytes().unwrap()).unwrap();
        assert_eq!(read.files, packed.files);

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("demo.tar.zst");
        read.write_bundle(&read.models[0], &path).unwrap();
        // The registry checks every digest, and that the parts fit each other.
        let bundle = registry::bundle::read(File::open(&path).unwrap(), &mut ()).unwrap();
        assert_eq!(bundle.manifest, read.models[0].manifest);
        assert_eq!(bundle.head.metrics["recognised"], Some(0.5));

        let model = Model::read(&bundle.manifest).unwrap();
        assert_ne!(model.part(&Role::VAE), Ok(vae.digest()), "rounded weights are another part");
        let entry = &bundle.manifest.files["vae/model.safetensors"];
        let file = &read.files[&entry.digest];
        let values = file[file.len() - 32..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()));
        for (i, (found, number)) in values.zip(numbers).enumerate() {
            let most = if i < 6 { f32::abs(number) / 256.0 } else { 0.0 };
            assert!((found - number).abs() <= most, "number {i}: {number} became {found}");
        }
    }

    #[test]
    fn a_damaged_pack_is_refused() {
        let pack = Pack { models: Vec::new(), files: BTreeMap::from([(Digest::of(b"abc"), b"abc".to_vec())]) };
        let whole = zstd::decode_all(&pack.to_bytes().unwrap()[..]).unwrap();
        let read = |bytes: &[u8]| Pack::read(&zstd::encode_all(bytes, 1).unwrap()).map_err(|error| error.to_string());
        assert!(read(&whole).is_ok());
        assert_eq!(read(&whole[..whole.len() - 1]).unwrap_err(), "it is cut");
        let mut changed = whole.clone();
        changed[whole.len() - 1] ^= 1;
        assert!(read(&changed).unwrap_err().contains("does not have its digest"));
    }
}
