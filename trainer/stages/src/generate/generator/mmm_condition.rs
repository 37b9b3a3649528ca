//! Conditions of MMM's network: the tokenizer's codes, captions and their words.

use burn::tensor::{Device, Tensor, TensorData};
use models::networks::MmmCondition;

use crate::parts::tokenizer::TrainedTokenizer;

/// The first codebook of a tokenizer, [K, d].
pub(crate) fn codebook(tokenizer: &TrainedTokenizer, device: &Device) -> Tensor<2> {
    let shape = [tokenizer.meta().codes, tokenizer.meta().code_dim];
    Tensor::from_data(TensorData::new(tokenizer.books()[0].clone(), shape), device)
}

/// The condition of captions. Each is its vector of `dim` numbers followed by one for each word; there is at least one
/// word.
pub(crate) fn with_words(codes_kd: &Tensor<2>, captions: &[&[f32]], dim: usize, device: &Device) -> MmmCondition {
    let counts: Vec<usize> = captions.iter().map(|caption| caption.len() / dim - 1).collect();
    let most = counts.iter().copied().max().unwrap_or(0);
    let pooled: Vec<f32> = captions.iter().flat_map(|caption| caption[..dim].iter().copied()).collect();
    let mut words = vec![0.0; captions.len() * most * dim];
    for (caption, to) in captions.iter().zip(words.chunks_exact_mut((most * dim).max(1))) {
        to[..caption.len() - dim].copy_from_slice(&caption[dim..]);
    }
    MmmCondition {
        codes_kd: codes_kd.clone(),
        text_bc: Tensor::from_data(TensorData::new(pooled, [captions.len(), dim]), device),
        words_bnc: Tensor::from_data(TensorData::new(words, [captions.len(), most, dim]), device),
        words: Some(counts),
    }
}
