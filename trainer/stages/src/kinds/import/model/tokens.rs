//! Published tokenizers, generators of tokens, and DisCoRD's decoder.

use models::flat::{Entry, layout};
use models::networks::{Gpt, Init, MaskedTransformer, Mmm, MomaskConfig, Projection, ResidualTransformer, Tokenizer};
use protocol::artifact::Role;
use protocol::stage::{
    Family, FlowBackbone, FlowNetwork, FlowPrediction, FlowProjection, TokenNetwork, TokenizerNetwork,
};
use protocol::units::counted;
use protocol::{ArtifactKind, Digest, Manifest};

use super::{Import, Network, part};
use crate::artifacts;
use crate::context::{AttemptContext, StageError};
use crate::generate::generator::{GeneratorMeta, MASKED_PREFIX, RESIDUAL_PREFIX, TOKENS};
use crate::parts;
use crate::parts::flow_decoder::{Backbone, FlowMeta, HEAD};
use crate::parts::tokenizer::TokenizerMeta;
use crate::published::sizes::TokenizerSizes;
use crate::published::{Checkpoint, Found, sizes};
use checkpoint::model::Parts;

/// Name of a single codebook, in our files and in those of T2M-GPT and MMM.
const CODEBOOK: (&str, &str) = ("quantizer.layers.0.codebook", "quantizer.codebook");
/// Upper limit of a tokenizer's dilations.
const REACH: usize = 10_000;

impl Import<'_> {
    fn tokenizer_input(&self, cx: &dyn AttemptContext) -> Result<(Digest, Manifest, TokenizerMeta), StageError> {
        let (digest, manifest) = artifacts::input(cx, "tokenizer", ArtifactKind::Tokenizer)?;
        let meta = artifacts::meta(&manifest, "the tokenizer")?;
        Ok((digest, manifest, meta))
    }

    pub(super) fn tokenizer(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let found = self.file.network(&sizes::TOKENIZER)?;
        let TokenizerSizes { config, codes, quantizers, single } = sizes::of_tokenizer(&found, self.settings.growth)?;
        let (format, mean, std) = self.statistics(cx, config.features, &found)?;
        let TokenizerNetwork { depth, growth, .. } = config.network;
        let reach = u32::try_from(depth).ok().and_then(|depth| growth.checked_pow(depth));
        if reach.is_none_or(|reach| reach > REACH) {
            return Err(found.refuse(format!(
                "its dilations grow to {growth}^{depth}; expected at most {REACH} frames; set `growth` to the value \
                 that it was trained with"
            )));
        }
        let meta = TokenizerMeta {
            format,
            features: config.features,
            codes,
            code_dim: config.dim,
            quantizers,
            network: config.network,
            mean,
            std,
        };
        let network = Tokenizer::new(&meta.config(), &mut Init::shapes(&self.device));
        let entries: Vec<Entry> = layout(&network).into_iter().chain(meta.books()).collect();
        let alias = |name: &str| match single && name == CODEBOOK.0 {
            true => CODEBOOK.1.to_owned(),
            false => name.to_owned(),
        };
        let taken = found.take(&entries, &alias)?;
        let network = self.taken(entries, taken);
        Ok(cx.put_manifest(&part(cx, ArtifactKind::Tokenizer, &meta, &[network])?)?)
    }

    /// Uploads a model of tokens with its parts.
    fn generator(
        &self,
        cx: &mut dyn AttemptContext,
        (family, network): (Family, TokenNetwork),
        (longest, text_dim): (usize, usize),
        (tokenizer, text): ((Digest, Manifest, TokenizerMeta), Manifest),
        networks: &[Network],
    ) -> Result<Digest, StageError> {
        let (digest, part, tokenizer) = tokenizer;
        let meta = GeneratorMeta {
            family,
            network,
            codes: tokenizer.codes,
            quantizers: tokenizer.quantizers,
            longest,
            text_dim,
            fits: Parts::from([(Role::TOKENIZER, digest), (Role::TEXT, text.digest())]),
        };
        let own = self::part(cx, ArtifactKind::TokenGenerator, &meta, networks)?;
        let parts = [(Role::GENERATOR, own), (Role::TOKENIZER, part), (Role::TEXT, text)];
        parts::publish_model(cx, TOKENS, tokenizer.format, &parts.into())
    }

    /// Refuses a network for other codebooks than the tokenizer's.
    fn expect_codes(found: &Found<'_>, codes: usize, tokenizer: &TokenizerMeta, one: bool) -> Result<(), StageError> {
        if codes != tokenizer.codes || (one && tokenizer.quantizers != 1) {
            return Err(found.refuse(format!(
                "it generates {codes} codes{}, but `tokenizer` has {} of {}; use the tokenizer that it was \
                 trained with",
                if one { " of one codebook" } else { "" },
                counted(tokenizer.quantizers, "codebook"),
                tokenizer.codes
            )));
        }
        Ok(())
    }

    pub(super) fn gpt(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let tokenizer = self.tokenizer_input(cx)?;
        let found = self.file.network(&sizes::GPT)?;
        let config = sizes::of_gpt(&found, self.settings.longest, self.heads)?;
        Self::expect_codes(&found, config.codes, &tokenizer.2, true)?;
        let text = self.text(cx, &found, config.text_dim)?;
        let network = self.network(&found, |init| Gpt::new(&config, init))?;
        let lengths = (config.block - 2, config.text_dim);
        self.generator(cx, (Family::Autoregressive, config.network), lengths, (tokenizer, text), &[network])
    }

    pub(super) fn mmm(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let tokenizer = self.tokenizer_input(cx)?;
        let found = self.file.network(&sizes::MMM)?;
        let config = sizes::of_mmm(&found, self.settings.longest, self.heads)?;
        Self::expect_codes(&found, config.codes, &tokenizer.2, true)?;
        if config.dim != tokenizer.2.code_dim {
            return Err(found.refuse(format!(
                "it expects codes of width {}, but those of `tokenizer` are {} wide; use the tokenizer that it was \
                 trained with",
                config.dim, tokenizer.2.code_dim
            )));
        }
        let text = self.text(cx, &found, config.text_dim)?;
        let network = self.network(&found, |init| Mmm::new(&config, init))?;
        let lengths = (config.block - 2, config.text_dim);
        self.generator(cx, (Family::Mmm, config.network), lengths, (tokenizer, text), &[network])
    }

    pub(super) fn momask(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let tokenizer = self.tokenizer_input(cx)?;
        let quantizers = tokenizer.2.quantizers;
        let found = self.file.network(&sizes::MASKED)?;
        let config = sizes::of_masked(&found, quantizers, self.heads)?;
        Self::expect_codes(&found, config.codes, &tokenizer.2, false)?;
        let text = self.text(cx, &found, config.text_dim)?;
        let mut networks =
            vec![self.network(&found, |init| MaskedTransformer::new(&config, init))?.under(MASKED_PREFIX)];
        match (self.settings.residual.as_str(), quantizers) {
            ("", 1) => {}
            ("", many) => {
                return Err(found.refuse(format!(
                    "`tokenizer` has {many} codebooks, but this network generates only the first; set `residual` to \
                     the file of the residual transformer"
                )));
            }
            _ => networks.push(self.above(cx, &config)?.under(RESIDUAL_PREFIX)),
        }
        let lengths = (self.settings.longest, config.text_dim);
        self.generator(cx, (Family::Masked, config.network), lengths, (tokenizer, text), &networks)
    }

    /// Reads MoMask's network of the layers above the first.
    fn above(&mut self, cx: &mut dyn AttemptContext, first: &MomaskConfig) -> Result<Network, StageError> {
        let path = self.given.path("residual")?;
        let file = Checkpoint::open(path)?;
        let found = file.network(&sizes::RESIDUAL)?;
        let config = sizes::of_residual(&found, self.heads)?;
        if config != *first {
            return Err(found.refuse(format!(
                "it has {}, but the masked transformer has {}; use two networks of the same size, trained with the same \
                 tokenizer",
                size_in_words(&config),
                size_in_words(first)
            )));
        }
        let entries = layout(&ResidualTransformer::new(&config, true, &mut Init::shapes(&self.device)));
        let taken = found.take(&entries, &str::to_owned)?;
        if let Some(left_out) = file.left_out(&taken.read) {
            cx.log(&format!("{}: tensors that were not read, by prefix: {left_out}", path.display()));
        }
        self.parameters += taken.values.len();
        Ok(Network { entries, taken })
    }

    pub(super) fn discord(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let (digest, _, tokenizer) = self.tokenizer_input(cx)?;
        let found = self.file.network(&sizes::UNET)?;
        let config = sizes::of_unet(&found, (self.heads, HEAD))?;
        if (config.features, config.token_dim) != (tokenizer.features, tokenizer.code_dim) {
            return Err(found.refuse(format!(
                "it expects {} features and codes of width {}, but `tokenizer` has {} and {}; use the tokenizer that \
                 it was trained with",
                config.features, config.token_dim, tokenizer.features, tokenizer.code_dim
            )));
        }
        let projection = match config.projection {
            Projection::Stack => FlowProjection::Stack,
            Projection::Repeat => FlowProjection::Repeat,
            Projection::Transposed => FlowProjection::Transposed,
            Projection::Upsample => {
                return Err(found.refuse("its projection is not supported; expected stack, repeat or transposed"));
            }
        };
        let meta = FlowMeta {
            format: tokenizer.format,
            features: config.features,
            code_dim: config.token_dim,
            backbone: FlowBackbone::Unet,
            prediction: FlowPrediction::Velocity,
            network: FlowNetwork {
                width: config.width,
                condition: config.condition_dim,
                layers: config.blocks,
                heads: self.heads,
                attention: config.attention.is_some(),
                projection,
                ..FlowNetwork::default()
            },
            solver: self.settings.solver.into(),
            steps: self.settings.solver_steps,
            fits: Parts::from([(Role::TOKENIZER, digest)]),
        };
        let Backbone::Unet(network) = meta.field(&mut Init::shapes(&self.device)).backbone else {
            return Err(StageError::Fault("expected a U-Net".into()));
        };
        let entries = layout(&network);
        let taken = found.take(&entries, &str::to_owned)?;
        let network = self.taken(entries, taken);
        Ok(cx.put_manifest(&part(cx, ArtifactKind::FlowDecoder, &meta, &[network])?)?)
    }
}

fn size_in_words(config: &MomaskConfig) -> String {
    let MomaskConfig { codes, quantizers, network, text_dim } = config;
    format!(
        "{} of {codes} codes, {} of width {}, feed-forward width {}, token width {} and caption width {text_dim}",
        counted(*quantizers, "codebook"),
        counted(network.layers, "layer"),
        network.width,
        network.feed_forward,
        network.embedding,
    )
}
