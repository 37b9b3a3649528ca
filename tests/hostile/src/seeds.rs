//! Small self-made files of every kind, from which mutation starts.

use std::io::{Cursor, Write as _};

use mocap::rig::Rig;
use motion::{features, npy, synthetic};
use protocol::Seed;
use protocol::stage::DataSynthetic;
use serde_json::{Value, json};

/// Joints `[5, 22, 3]` of a synthetic clip.
pub(crate) fn joints() -> Vec<f32> {
    let dataset = synthetic::generate(&DataSynthetic { clips: 1, ..DataSynthetic::default() }, Seed(1));
    let joints = features::recover_joints(&dataset.clips[0].features, dataset.skeleton());
    joints[..5 * 66].to_vec()
}

/// Converts texts to files.
fn texts(texts: &[&str]) -> Vec<Vec<u8>> {
    texts.iter().map(|text| text.as_bytes().to_vec()).collect()
}

/// Recordings: one of ours, and the styles of other programs.
pub fn bvh() -> Vec<Vec<u8>> {
    let skeleton = motion::Skeleton::of(protocol::stage::DataFormat::Humanml3d);
    let ours = Rig::fit(&joints(), skeleton).expect("a clip of ours").to_bvh(20.0, 100.0).to_text();
    let mut all = texts(&[
        "HIERARCHY\nROOT a b{OFFSET 0 0 0 CHANNELS 2 Xposition yrotation End Site{OFFSET 0 1 0}}\nMOTION\nFrames: 2\nFrame Time: .0333\n1 90\n2 -90\n",
        "HIERARCHY\r\nROOT Hips\r\n{\r\n\tOFFSET 0 0 0\r\n\tCHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation\r\n\tJOINT LeftUpLeg\r\n\t{\r\n\t\tOFFSET 3.9 0 0\r\n\t\tCHANNELS 3 Zrotation Yrotation Xrotation\r\n\t\tEnd Site\r\n\t\t{\r\n\t\t\tOFFSET 0 -18 0\r\n\t\t}\r\n\t}\r\n}\r\nMOTION\r\nFrames:\t1\r\nFrame Time:\t8.333e-3\r\n0 90.5 0 1 2 3 4 5 6\r\n",
    ]);
    all.push(ours.into_bytes());
    all
}

/// Shipped joint maps.
pub fn joint_map() -> Vec<Vec<u8>> {
    let shipped = mocap::joint_map::SHIPPED;
    shipped.iter().step_by(2).map(|(_, text)| text.as_bytes().to_vec()).collect()
}

fn array(header: &str, data: &[u8]) -> Vec<u8> {
    [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), data].concat()
}

/// Arrays of joints, of features, and in 64 bits.
pub fn npy() -> Vec<Vec<u8>> {
    let numbers: Vec<u8> = (0..66).flat_map(|i| (f64::from(i) * 0.1).to_le_bytes()).collect();
    vec![
        npy::to_bytes(&[5, 22, 3], &joints()),
        npy::to_bytes(&[2, 63], &[0.5; 126]),
        array("{'descr': '<f8', 'fortran_order': False, 'shape': (1, 22, 3), }\n", &numbers),
    ]
}

fn archive(members: &[(&str, Vec<u8>)], packed: bool) -> Vec<u8> {
    let method = if packed { zip::CompressionMethod::Deflated } else { zip::CompressionMethod::Stored };
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in members {
        archive.start_file(*name, options).expect("in memory");
        archive.write_all(bytes).expect("in memory");
    }
    archive.finish().expect("in memory").into_inner()
}

/// Archives of arrays, packed and unpacked, and a plain array, which is accepted in place of an archive.
pub fn npz() -> Vec<Vec<u8>> {
    let joints = npy::to_bytes(&[5, 22, 3], &joints());
    let rate = array("{'descr': '<f8', 'fortran_order': False, 'shape': (), }\n", &60_f64.to_le_bytes());
    let fps = array("{'descr': '<i8', 'fortran_order': False, 'shape': (), }\n", &30_i64.to_le_bytes());
    vec![
        archive(&[("joints.npy", joints.clone()), ("mocap_framerate.npy", rate)], true),
        archive(&[("fps.npy", fps), ("Jtr.npy", joints.clone())], false),
        joints,
    ]
}

/// Captions beside a clip, and lines of HumanML3D.
pub fn texts_of_clips() -> Vec<Vec<u8>> {
    texts(&[
        "a man walks.#a/DET man/NOUN walk/VERB#0.0#0.0\nhe turns left.#he/PRON turn/VERB left/ADV#1.5#3.25\n",
        "A person walks.\n\n  someone turns counter-clockwise \n",
        "x#x/X#nan#nan#more\nkicks#kick/VERB#4#2\n",
    ])
}

/// Tables of captions.
pub fn captions() -> Vec<Vec<u8>> {
    texts(&[
        "name,Caption,from,to,source\r\nwalks/a.bvh,\"a man, \"\"slowly\"\",\nwalks\",,,take 1\r\n\r\nb,turns left,0.5,3,\r\n",
        r#"[{"clip": "b", "caption": "turns left", "from": 0.5, "to": 3}, {"clip": "c", "text": ["x", "y"], "take": "t"}]"#,
        r#"{"b": "turns left", "c": ["x", "a person runs"]}"#,
    ])
}

/// Sentences to generate from, in both formats.
pub fn sentences() -> Vec<Vec<u8>> {
    texts(&[
        "a person walks\n  a man, \"waving\" # 120 \nwaves#4.5s\njumps#NA\n",
        "{\"caption\": \"a person walks\"}\n\n{\"caption\": \"a man\", \"frames\": 120}\n{\"seconds\": 4.5, \"caption\": \"waves\"}\n\"jumps\"\n",
    ])
}

/// Pipelines: a minimal training, and one with anchors, lists and a sweep.
pub fn pipeline() -> Vec<Vec<u8>> {
    texts(&[
        "name: p\nseed: 7\ndataset: {format: synthetic, clips: 40}\nstages:\n  vae: {kind: train.vae, steps: 10, batch: {global: 8, slices: 2}, lr: 1e-3}\n  latents: {kind: encode.latents, vae: vae}\n  mld: {kind: train.mld, steps: 20}\n",
        "name: q\ndataset: {format: humanml3d, path: data/HumanML3D}\ntext: {encoder: clip, path: data/clip}\nstages:\n  vae: &vae\n    kind: train.vae\n    network: {width: 64, layers: 3, heads: 4}\n    loss: {joint_from: 0.6}\n  other: *vae\n  latents: {kind: encode.latents, vae: vae, crops: 4, shards: 2}\n  mld:\n    kind: train.mld\n    steps: 100\n    sweep: {search: random, trials: 4, metric: latent_fid, settings: {lr: {log: [1e-5, 1e-3]}}}\n  release: {kind: register, model: q, from: [mld], metric: latent_fid, mode: min, gates: ['latent_fid <= 0.5'], promote: {to: staging}}\n",
    ])
}

/// Target paths of a motion, as a table and as a document.
pub fn waypoints() -> Vec<Vec<u8>> {
    texts(&[
        "t,joint,x,y,z\n0,pelvis,0,0.9,0\n\n1.01, left_wrist ,0.2,1.2,0.5\n0.5,pelvis,0,0.9,1\n",
        "x,y,z,t\n1,2,3,0.1\n",
        r#"{"pelvis": [[0, 0, 0.9, 0], [0.5, 0, 0.9, 1]], "left_wrist": [[1.0, 0.2, 1.2, 0.5]]}"#,
        "[[0, 0, 1, 0], [1, 0, 1, 0.5]]",
    ])
}

fn tensors(header: &Value, data: &[u8]) -> Vec<u8> {
    let header = header.to_string();
    [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), data].concat()
}

/// Safetensors of all supported types.
pub fn safetensors() -> Vec<Vec<u8>> {
    let header = json!({
        "__metadata__": {"format": "pt"},
        "a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]},
        "b.weight": {"dtype": "BF16", "shape": [2], "data_offsets": [24, 28]},
        "c": {"dtype": "I64", "shape": [1], "data_offsets": [28, 36]},
        "d": {"dtype": "F16", "shape": [], "data_offsets": [36, 38]},
    });
    let one = json!({"a": {"dtype": "F16", "shape": [2], "data_offsets": [0, 4]}});
    vec![tensors(&header, &[1; 38]), tensors(&one, &[0, 0x3c, 0, 0xc0])]
}

fn special(id: u64, token: &str) -> Value {
    json!({"id": id, "content": token, "single_word": false, "lstrip": false, "rstrip": false, "normalized": true, "special": true})
}

/// A CLIP tokenizer of seven tokens.
fn clip_tokenizer() -> Value {
    let (start, end) = ("<|startoftext|>", "<|endoftext|>");
    let words = "'s|'t|[\\p{L}]+|[\\p{N}]|[^\\s\\p{L}\\p{N}]+";
    json!({
        "version": "1.0", "truncation": null, "padding": null,
        "added_tokens": [special(4, start), special(5, end)],
        "normalizer": {"type": "Sequence", "normalizers": [
            {"type": "NFC"}, {"type": "Replace", "pattern": {"Regex": "\\s+"}, "content": " "}, {"type": "Lowercase"},
        ]},
        "pre_tokenizer": {"type": "Sequence", "pretokenizers": [
            {"type": "Split", "pattern": {"Regex": words}, "behavior": "Removed", "invert": true},
            {"type": "ByteLevel", "add_prefix_space": false, "trim_offsets": true, "use_regex": true},
        ]},
        "post_processor": {
            "type": "RobertaProcessing", "sep": [end, 5], "cls": [start, 4], "trim_offsets": false, "add_prefix_space": false,
        },
        "decoder": null,
        "model": {
            "type": "BPE", "dropout": null, "unk_token": end, "continuing_subword_prefix": "", "end_of_word_suffix": "</w>",
            "fuse_unk": false, "byte_fallback": false, "ignore_merges": false,
            "vocab": {"a": 0, "b": 1, "a</w>": 2, "ab</w>": 3, start: 4, end: 5, "b</w>": 6},
            "merges": [["a", "b</w>"]],
        },
    })
}

/// A T5 tokenizer of seven tokens with an empty table of characters.
fn t5_tokenizer() -> Value {
    json!({
        "version": "1.0", "truncation": null, "padding": null,
        "added_tokens": [special(0, "<pad>"), special(1, "</s>"), special(2, "<unk>")],
        "normalizer": {"type": "Sequence", "normalizers": [{"type": "NFKC"}, {"type": "Replace", "pattern": {"Regex": " {2,}"}, "content": " "}]},
        "pre_tokenizer": {"type": "Metaspace", "replacement": "\u{2581}", "prepend_scheme": "always", "split": true},
        "post_processor": {
            "type": "TemplateProcessing",
            "single": [{"Sequence": {"id": "A", "type_id": 0}}, {"SpecialToken": {"id": "</s>", "type_id": 0}}],
            "pair": [{"Sequence": {"id": "A", "type_id": 0}}, {"SpecialToken": {"id": "</s>", "type_id": 0}}, {"Sequence": {"id": "B", "type_id": 0}}],
            "special_tokens": {"</s>": {"id": "</s>", "ids": [1], "tokens": ["</s>"]}},
        },
        "decoder": null,
        "model": {"type": "Unigram", "unk_id": 2, "byte_fallback": false, "vocab": [
            ["<pad>", 0.0], ["</s>", 0.0], ["<unk>", 0.0], ["\u{2581}", -2.0], ["a", -1.5], ["b", -3.5], ["\u{2581}ab", -1.0],
        ]},
    })
}

/// Tokenizers of both kinds.
pub fn tokenizer() -> Vec<Vec<u8>> {
    [clip_tokenizer(), t5_tokenizer()].map(|value| value.to_string().into_bytes()).to_vec()
}

/// The files of a small CLIP and of a small Sentence-T5, by path; each may be mutated.
pub fn encoder_folder(sentence: bool) -> Vec<(&'static str, Vec<u8>)> {
    let text = |value: Value| value.to_string().into_bytes();
    if sentence {
        let config = json!({"model_type": "t5", "vocab_size": 7, "d_model": 4, "d_kv": 2, "d_ff": 3, "num_layers": 1, "num_heads": 2,
            "relative_attention_num_buckets": 4, "relative_attention_max_distance": 8, "feed_forward_proj": "relu"});
        let modules = json!([
            {"idx": 0, "name": "0", "path": "", "type": "sentence_transformers.models.Transformer"},
            {"idx": 1, "name": "1", "path": "1_Pooling", "type": "sentence_transformers.models.Pooling"},
            {"idx": 2, "name": "2", "path": "2_Dense", "type": "sentence_transformers.models.Dense"},
            {"idx": 3, "name": "3", "path": "3_Normalize", "type": "sentence_transformers.models.Normalize"},
        ]);
        let pooling =
            json!({"word_embedding_dimension": 4, "pooling_mode_cls_token": false, "pooling_mode_mean_tokens": true});
        let dense = json!({"in_features": 4, "out_features": 3, "bias": false, "activation_function": "torch.nn.modules.linear.Identity"});
        let block = |name: &str| format!("encoder.block.0.layer.{name}.weight");
        let network: Vec<(String, Vec<usize>)> = vec![
            ("shared.weight".into(), vec![7, 4]),
            (block("0.SelfAttention.q"), vec![4, 4]),
            (block("0.SelfAttention.k"), vec![4, 4]),
            (block("0.SelfAttention.v"), vec![4, 4]),
            (block("0.SelfAttention.o"), vec![4, 4]),
            (block("0.SelfAttention.relative_attention_bias"), vec![4, 2]),
            (block("0.layer_norm"), vec![4]),
            (block("1.DenseReluDense.wi"), vec![3, 4]),
            (block("1.DenseReluDense.wo"), vec![4, 3]),
            (block("1.layer_norm"), vec![4]),
            ("encoder.final_layer_norm.weight".into(), vec![4]),
        ];
        return vec![
            ("modules.json", text(modules)),
            ("config.json", text(config)),
            ("tokenizer.json", text(t5_tokenizer())),
            ("tokenizer_config.json", text(json!({"model_max_length": 16, "eos_token": "</s>"}))),
            ("special_tokens_map.json", text(json!({"eos_token": {"content": "</s>"}}))),
            ("sentence_bert_config.json", text(json!({"max_seq_length": 8, "do_lower_case": false}))),
            ("model.safetensors", weights(&network)),
            ("1_Pooling/config.json", text(pooling)),
            ("2_Dense/config.json", text(dense)),
            ("2_Dense/model.safetensors", weights(&[("linear.weight".into(), vec![3, 4])])),
        ];
    }
    let config = json!({"model_type": "clip_text_model", "vocab_size": 7, "hidden_size": 4, "intermediate_size": 3, "num_hidden_layers": 1,
        "num_attention_heads": 2, "max_position_embeddings": 8, "projection_dim": 3, "hidden_act": "quick_gelu", "eos_token_id": 5});
    let vocab = json!({"a": 0, "b": 1, "a</w>": 2, "ab</w>": 3, "<|startoftext|>": 4, "<|endoftext|>": 5, "b</w>": 6});
    let (embeddings, layer) = ("text_model.embeddings", "text_model.encoder.layers.0");
    let mut network: Vec<(String, Vec<usize>)> = vec![
        (format!("{embeddings}.token_embedding.weight"), vec![7, 4]),
        (format!("{embeddings}.position_embedding.weight"), vec![8, 4]),
        (format!("{layer}.mlp.fc1.weight"), vec![3, 4]),
        (format!("{layer}.mlp.fc1.bias"), vec![3]),
        (format!("{layer}.mlp.fc2.weight"), vec![4, 3]),
        (format!("{layer}.mlp.fc2.bias"), vec![4]),
        ("text_model.final_layer_norm.weight".into(), vec![4]),
        ("text_model.final_layer_norm.bias".into(), vec![4]),
        ("text_projection.weight".into(), vec![3, 4]),
    ];
    for part in ["k_proj", "v_proj", "q_proj", "out_proj"] {
        network.push((format!("{layer}.self_attn.{part}.weight"), vec![4, 4]));
        network.push((format!("{layer}.self_attn.{part}.bias"), vec![4]));
    }
    for part in ["layer_norm1", "layer_norm2"] {
        network.push((format!("{layer}.{part}.weight"), vec![4]));
        network.push((format!("{layer}.{part}.bias"), vec![4]));
    }
    let index: serde_json::Map<String, Value> =
        network.iter().map(|(name, _)| (name.clone(), json!("weights-1"))).collect();
    vec![
        ("config.json", text(config)),
        ("vocab.json", text(vocab)),
        ("merges.txt", b"#version: 0.2\na b</w>\n".to_vec()),
        ("tokenizer_config.json", text(json!({"model_max_length": 8, "bos_token": {"content": "<|startoftext|>"}}))),
        ("special_tokens_map.json", text(json!({"pad_token": "<|endoftext|>"}))),
        ("model.safetensors.index.json", text(json!({"weight_map": index}))),
        ("weights-1", weights(&network)),
    ]
}

/// Safetensors of zeros with these names and shapes.
fn weights(specs: &[(String, Vec<usize>)]) -> Vec<u8> {
    let (mut header, mut end) = (serde_json::Map::new(), 0);
    for (name, shape) in specs {
        let begin = end;
        end += 4 * shape.iter().product::<usize>();
        header.insert(name.clone(), json!({"dtype": "F32", "shape": shape, "data_offsets": [begin, end]}));
    }
    tensors(&Value::Object(header), &vec![0; end])
}

/// Each file of the two folders, preceded by one byte with its index.
pub fn encoder() -> Vec<Vec<u8>> {
    let folders = [encoder_folder(false), encoder_folder(true)].concat();
    folders.into_iter().enumerate().map(|(i, (_, bytes))| [vec![i as u8], bytes].concat()).collect()
}

/// Pickles a text.
fn text(text: &str) -> Vec<u8> {
    [b"X", &(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

/// Pickles `torch._utils._rebuild_tensor_v2` of three by four numbers of storage `0`, as `torch.save` does.
fn tensor(module: &str) -> Vec<u8> {
    let storage = [
        b"(".to_vec(),
        text("storage"),
        format!("c{module}\nFloatStorage\n").into_bytes(),
        text("0"),
        text("cpu"),
        b"K\x0ctQ".to_vec(),
    ];
    [
        b"ctorch._utils\n_rebuild_tensor_v2\n(".to_vec(),
        storage.concat(),
        b"K\x00K\x03K\x04\x86K\x04K\x01\x86\x89ccollections\nOrderedDict\n)RtR".to_vec(),
    ]
    .concat()
}

/// Pickles a dict with a tensor; with `keys`, a dict of such dicts.
fn state_dict(keys: &[&str]) -> Vec<u8> {
    let one = [b"}".to_vec(), text("linear.weight"), tensor("torch"), b"s".to_vec()].concat();
    let all = keys.iter().map(|key| [text(key), one.clone(), b"s".to_vec()].concat());
    let body = if keys.is_empty() { one.clone() } else { [b"}".to_vec(), all.collect::<Vec<_>>().concat()].concat() };
    [b"\x80\x02".to_vec(), body, b".".to_vec()].concat()
}

/// Pickles a dict from words to numbers.
pub fn pickled_rows(rows: &[(&str, u8)]) -> Vec<u8> {
    let pairs = rows.iter().map(|(word, row)| [text(word), vec![b'K', *row], b"s".to_vec()].concat());
    [b"\x80\x02}".to_vec(), pairs.collect::<Vec<_>>().concat(), b".".to_vec()].concat()
}

/// The archive that `torch.save` writes for such a dict.
pub fn torch_archive(keys: &[&str]) -> Vec<u8> {
    let members = [
        ("archive/data.pkl", state_dict(keys)),
        ("archive/byteorder", b"little".to_vec()),
        ("archive/data/0", (0..12).flat_map(|i| (i as f32).to_le_bytes()).collect()),
        ("archive/version", b"3\n".to_vec()),
    ];
    archive(&members, false)
}

/// The format before the archive: consecutive pickles, then storages.
pub fn torch_legacy(keys: &[&str]) -> Vec<u8> {
    let magic = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.";
    let system = [b"\x80\x02}".to_vec(), text("little_endian"), b"\x88s.".to_vec()].concat();
    let storages = [b"\x80\x02]".to_vec(), text("0"), b"a.".to_vec()].concat();
    let numbers: Vec<u8> = (0..12).flat_map(|i| (i as f32).to_le_bytes()).collect();
    [
        magic.to_vec(),
        b"\x80\x02M\xe9\x03.".to_vec(),
        system,
        state_dict(keys),
        storages,
        12_u64.to_le_bytes().to_vec(),
        numbers,
    ]
    .concat()
}

/// Pickles of tensors in both formats.
pub fn torch() -> Vec<Vec<u8>> {
    vec![torch_archive(&[]), torch_legacy(&[]), state_dict(&[])]
}

/// A pickle that runs a command if Python unpickles it.
pub fn pickle_that_runs(command: &str) -> Vec<u8> {
    [b"\x80\x02cposix\nsystem\n(".to_vec(), text(command), b"tR.".to_vec()].concat()
}

/// Like [`pickle_that_runs`], in the archive format of `torch.save`.
pub fn archive_that_runs(command: &str) -> Vec<u8> {
    archive(&[("archive/data.pkl", pickle_that_runs(command)), ("archive/version", b"3\n".to_vec())], false)
}

/// An archive of zeros that pack to a thousandth.
pub fn zip_bomb(members: &[&str], bytes: usize) -> Vec<u8> {
    let members: Vec<(&str, Vec<u8>)> = members.iter().map(|name| (*name, vec![0; bytes])).collect();
    archive(&members, true)
}

/// Joints as bytes: of a clip, and of a figure whose joints coincide.
pub fn motions() -> Vec<Vec<u8>> {
    let bytes = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
    vec![bytes(&joints()), bytes(&[0.0; 132]), bytes(&[1e30; 66])]
}
