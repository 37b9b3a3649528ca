//! Codebooks: the assignment of rows to codes, and the updates of codes from their rows.
//!
//! Source: the exponential-moving-average quantiser with resets of T2M-GPT (Zhang et al., CVPR 2023; van den Oord et
//! al., arXiv:1711.00937, appendix A.1). MoMask (Guo et al., CVPR 2024) stacks it on residuals; MMM (Pinyoanuntapong et
//! al., CVPR 2024) has another reset rule. Notation: N rows of width d, K codes.
//!
//! Codes are f32 buffers on the host that no optimizer changes. Every update is computed from sums over the rows of a
//! batch, so a batch may be cut into slices. Draws are arguments.
//!
//! Departs: scores leave out the rows' own norms, which are the same for every code.

use burn::tensor::{Device, Tensor, TensorData};

use crate::kernels;

/// Temperature of drawn codes, fixed in MoMask's training pass.
pub const TEMPERATURE: f32 = 0.5;
/// The id of "no code": it adds the zero vector.
pub const NO_CODE: i64 = -1;
/// Updates of MMM's quantiser between two checks for unused codes.
const LOOK_EVERY: f32 = 20.0;

/// Fills the draws of one row: layer, row, and one uniform number in [0, 1) per code.
pub type Uniforms<'a> = &'a mut dyn FnMut(usize, usize, &mut [f32]);

/// Fills the draws of one row of one layer: row, and one uniform number per code.
pub type LayerUniforms<'a> = &'a mut dyn FnMut(usize, &mut [f32]);

/// The Gumbel variable `-log(-log(u))`, with both arguments at least 1e-20.
pub fn gumbel(uniform: f32) -> f32 {
    const LEAST: f32 = 1e-20;
    -((-(uniform.max(LEAST).ln())).max(LEAST).ln())
}

/// The code of each of `rows` [N, d] in `codes` [K, d]: the nearest one. With `uniforms` it is the largest of
/// `-distance / 0.5 + gumbel`, the distance squared. Ties go to the first.
///
/// # Panics
/// If there are no codes.
pub fn assign(
    rows: &[f32],
    codes: &[f32],
    width: usize,
    device: &Device,
    mut uniforms: Option<LayerUniforms<'_>>,
) -> Vec<usize> {
    let n = rows.len() / width;
    let k = codes.len() / width;
    assert!(k > 0, "a codebook has codes");
    let tensor = |values: &[f32], rows| Tensor::<2>::from_data(TensorData::new(values.to_vec(), [rows, width]), device);
    let products = kernels::linear(tensor(rows, n), tensor(codes, k), None).into_data();
    let products = products.as_slice::<f32>().expect("f32 throughout");
    let norms: Vec<f32> = codes.chunks_exact(width).map(|code| code.iter().map(|c| c * c).sum()).collect();
    let mut draws = vec![0.0; k];
    let code = |(row, products): (usize, &[f32])| {
        let near = products.iter().zip(&norms).map(|(product, norm)| 2.0 * product - norm);
        match &mut uniforms {
            None => first_largest(near),
            Some(uniforms) => {
                uniforms(row, &mut draws);
                first_largest(near.zip(&draws).map(|(near, u)| near / TEMPERATURE + gumbel(*u)))
            }
        }
    };
    products.chunks_exact(k).enumerate().map(code).collect()
}

/// The index of the first largest value; 0 if there are no values.
pub fn first_largest(values: impl Iterator<Item = f32>) -> usize {
    let mut best = (0, f32::NEG_INFINITY);
    for (i, value) in values.enumerate() {
        if value > best.1 {
            best = (i, value);
        }
    }
    best.0
}

/// The input and result of one layer.
#[derive(Debug, Clone, PartialEq)]
pub struct LayerPass {
    /// Rows that the layer quantises, [N, d]: the residuals of the layers before it.
    pub rows: Vec<f32>,
    /// Code of each row.
    pub codes: Vec<usize>,
}

impl LayerPass {
    /// The number of rows of each of `count` codes, and their sum [K, d].
    pub fn statistics(&self, count: usize, width: usize) -> (Vec<f32>, Vec<f32>) {
        let mut counts = vec![0.0; count];
        let mut sums = vec![0.0; count * width];
        for (row, code) in self.rows.chunks_exact(width).zip(&self.codes) {
            counts[*code] += 1.0;
            sums[code * width..(code + 1) * width].iter_mut().zip(row).for_each(|(sum, r)| *sum += r);
        }
        (counts, sums)
    }
}

/// Quantisation of rows by a stack of codebooks, each of which quantises the residuals of those before it.
#[derive(Debug, Clone, PartialEq)]
pub struct Pass {
    /// The active layers, in order.
    pub layers: Vec<LayerPass>,
    /// Sum of the assigned codes, [N, d].
    pub sum: Vec<f32>,
    width: usize,
}

impl Pass {
    /// Quantises `rows` [N, d] by the first `active` layers. `codebook` returns a layer's codes [K, d] for its rows.
    pub fn through<'a>(
        rows: Vec<f32>,
        width: usize,
        active: usize,
        device: &Device,
        mut codebook: impl FnMut(usize, &[f32]) -> std::borrow::Cow<'a, [f32]>,
        mut uniforms: Option<Uniforms<'_>>,
    ) -> Self {
        let mut sum = vec![0.0; rows.len()];
        let mut layers = Vec::with_capacity(active);
        let mut left = rows;
        for layer in 0..active {
            let book = codebook(layer, &left);
            let codes = match &mut uniforms {
                None => assign(&left, &book, width, device, None),
                Some(uniforms) => {
                    let mut of_layer = |row: usize, out: &mut [f32]| uniforms(layer, row, out);
                    assign(&left, &book, width, device, Some(&mut of_layer))
                }
            };
            let rows = left.clone();
            for ((left, sum), code) in left.chunks_exact_mut(width).zip(sum.chunks_exact_mut(width)).zip(&codes) {
                let code = &book[code * width..(code + 1) * width];
                for ((left, sum), code) in left.iter_mut().zip(sum).zip(code) {
                    *left -= code;
                    *sum += code;
                }
            }
            layers.push(LayerPass { rows, codes });
        }
        Self { layers, sum, width }
    }

    /// The quantised rows as the decoder receives them, [N, d], and the commitment loss. The loss is the squared
    /// distance of each active layer's rows to their codes, summed over rows, width and layers.
    ///
    /// `rows` are those of [`through`](Self::through), tracked. The gradient of the quantised rows reaches them once
    /// for every active layer, because each of upstream's layers passes it straight through.
    pub fn straight_through(&self, rows_nd: Tensor<2>) -> (Tensor<2>, Tensor<1>) {
        let dims = rows_nd.dims();
        let device = rows_nd.device();
        let constant = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, dims), &device);
        let passed = rows_nd.clone() * self.layers.len() as f32;
        let quantised = passed.clone() - passed.detach() + constant(self.sum.clone());
        // The residual of a layer is the input of the next.
        let after = self.layers.iter().skip(1).map(|layer| layer.rows.clone());
        let whole = &self.layers[0].rows;
        let last = whole.iter().zip(&self.sum).map(|(row, sum)| row - sum).collect();
        let commitment = after.chain([last]).map(|left| {
            // Everything up to this layer's code is subtracted from the tracked rows.
            let taken = whole.iter().zip(&left).map(|(row, left)| row - left).collect();
            (rows_nd.clone() - constant(taken)).square().sum()
        });
        (quantised, commitment.reduce(|a, b| a + b).expect("a layer is active"))
    }

    /// Ids by row and layer, [N, layers], with [`NO_CODE`] for inactive layers.
    pub fn ids(&self, layers: usize) -> Vec<i64> {
        let rows = self.sum.len() / self.width;
        let id = |row: usize, layer: usize| self.layers.get(layer).map_or(NO_CODE, |pass| pass.codes[row] as i64);
        (0..rows).flat_map(|row| (0..layers).map(move |layer| id(row, layer))).collect()
    }
}

/// Sums of codes [N, d] for ids [N, layers]; [`NO_CODE`] and layers missing from `ids` add nothing.
///
/// # Panics
/// If an id is neither a code nor [`NO_CODE`].
pub fn look_up(ids: &[i64], layers: usize, books: &[Vec<f32>], width: usize) -> Vec<f32> {
    let mut out = vec![0.0; ids.len() / layers * width];
    for (sum, ids) in out.chunks_exact_mut(width).zip(ids.chunks_exact(layers)) {
        for (id, book) in ids.iter().zip(books).filter(|(id, _)| **id != NO_CODE) {
            let at = usize::try_from(*id).expect("ids are codes or -1") * width;
            sum.iter_mut().zip(&book[at..at + width]).for_each(|(sum, code)| *sum += code);
        }
    }
    out
}

/// The effective number of codes in use: `exp(-sum p log(p + 1e-7))` of their shares.
pub fn perplexity(counts: &[f32]) -> f64 {
    let all: f64 = counts.iter().map(|c| f64::from(*c)).sum();
    let entropy = |count: &f32| {
        let share = f64::from(*count) / all;
        share * (share + 1e-7).ln()
    };
    (-counts.iter().map(entropy).sum::<f64>()).exp()
}

/// Standard deviation of the noise on repeated rows.
fn spread(width: usize) -> f32 {
    (0.01 / (width as f64).sqrt()) as f32
}

/// Candidates for new codes: the first `count` of `rows` [N, d]. Fewer rows are repeated, and `0.01 / sqrt(d)` times
/// `noise` is added to all of them. `noise` is standard normal, one value per element of the repeated rows (see
/// [`noise_len`]).
pub fn candidates(rows: &[f32], count: usize, width: usize, noise: impl FnOnce(usize) -> Vec<f32>) -> Vec<f32> {
    let wanted = count * width;
    match noise_len(rows.len(), wanted) {
        0 => rows[..wanted].to_vec(),
        len => {
            let spread = spread(width);
            rows.iter().cycle().zip(noise(len)).map(|(row, noise)| row + noise * spread).take(wanted).collect()
        }
    }
}

/// The number of noise values that [`candidates`] needs for `rows` values of rows and `wanted` values of codes.
pub fn noise_len(rows: usize, wanted: usize) -> usize {
    if rows >= wanted { 0 } else { rows * wanted.div_ceil(rows.max(1)) }
}

/// One codebook and its running statistics.
#[derive(Debug)]
pub struct Book<'a> {
    /// Codes, [K, d].
    pub codes: &'a mut [f32],
    /// Running sums of rows, [K, d].
    pub sums: &'a mut [f32],
    /// Running counts, [K].
    pub counts: &'a mut [f32],
    /// Decay of sums and counts in each update.
    pub decay: f64,
}

impl Book<'_> {
    /// Sets the initial codes, with sums equal to them and counts of 1.
    pub fn start(&mut self, codes: &[f32]) {
        self.codes.copy_from_slice(codes);
        self.sums.copy_from_slice(codes);
        self.counts.fill(1.0);
    }

    /// Updates running sums and counts with those of a batch.
    fn follow(&mut self, sums: &[f32], counts: &[f32]) {
        let keep = self.decay as f32;
        let take = (1.0 - self.decay) as f32;
        // Two roundings: a count of one row in the first update must stay exactly 1.
        let follow = |kept: &mut [f32], new: &[f32]| {
            kept.iter_mut().zip(new).for_each(|(kept, new)| *kept = keep * *kept + take * new);
        };
        follow(self.sums, sums);
        follow(self.counts, counts);
    }

    /// Sets codes for which `stays` to sum over count, and the others to their row of `replacements`. Returns the
    /// number of replaced codes.
    ///
    /// A count below the smallest normal number means that no row used the code for thousands of steps; it keeps its
    /// value.
    fn set(&mut self, replacements: Option<&[f32]>, stays: impl Fn(usize, f32) -> bool) -> usize {
        let width = self.codes.len() / self.counts.len();
        let mut replaced = 0;
        for (k, count) in self.counts.iter().enumerate() {
            let range = k * width..(k + 1) * width;
            let code = &mut self.codes[range.clone()];
            match replacements {
                Some(rows) if !stays(k, *count) => {
                    code.copy_from_slice(&rows[range]);
                    replaced += 1;
                }
                _ if *count < f32::MIN_POSITIVE => {}
                _ => code.iter_mut().zip(&self.sums[range]).for_each(|(code, sum)| *code = sum / count),
            }
        }
        replaced
    }

    /// Makes one update of T2M-GPT and MoMask: codes with a running count of at least 1 move to their mean. All others
    /// are set to their row of `replacements` [K, d], in every update until their count has grown. Returns the number
    /// of replaced codes.
    pub fn update(&mut self, sums: &[f32], counts: &[f32], replacements: &[f32]) -> usize {
        self.follow(sums, counts);
        self.set(Some(replacements), |_, count| count >= 1.0)
    }

    /// Makes one update of MMM: all codes move to their means. Every 21st update replaces the codes whose count has
    /// never reached 1, which `used` records. `since` counts the updates since the last replacement. Both start as
    /// zeros.
    pub fn update_remembering(
        &mut self,
        sums: &[f32],
        counts: &[f32],
        replacements: &[f32],
        used: &mut [f32],
        since: &mut f32,
    ) -> usize {
        self.follow(sums, counts);
        used.iter_mut().zip(&*self.counts).for_each(|(used, count)| *used = used.max(f32::from(*count >= 1.0)));
        let looks = *since >= LOOK_EVERY;
        *since = if looks { 0.0 } else { *since + 1.0 };
        self.set(looks.then_some(replacements), |k, _| used[k] > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gradient_passes_once_for_every_layer_and_the_value_is_the_codes() {
        let device = Device::flex().autodiff();
        let rows = vec![0.3, -0.2, 1.1, 0.4, -0.6, 0.8];
        let books = [vec![0.0, 0.0, 1.0, 0.5], vec![0.25, -0.25, -0.5, 0.75, 0.1, 0.0]];
        let book = |layer: usize, _: &[f32]| std::borrow::Cow::<[f32]>::Borrowed(books[layer].as_slice());
        let pass = Pass::through(rows.clone(), 2, 2, &Device::flex(), book, None);
        assert_eq!(look_up(&pass.ids(2), 2, &books, 2), pass.sum);
        assert_eq!(pass.ids(3).iter().filter(|id| **id == NO_CODE).count(), 3);
        let x = Tensor::<2>::from_data(TensorData::new(rows.clone(), [3, 2]), &device).require_grad();
        let (quantised, commitment) = pass.straight_through(x.clone());
        let values = quantised.clone().into_data();
        assert_eq!(values.as_slice::<f32>().unwrap(), pass.sum);
        let gradient = x.grad(&quantised.sum().backward()).unwrap().into_data();
        assert_eq!(gradient.as_slice::<f32>().unwrap(), [2.0; 6]);
        let left: f32 = pass.layers[1].rows.iter().map(|r| r * r).sum();
        let last: f32 = rows.iter().zip(&pass.sum).map(|(r, s)| (r - s) * (r - s)).sum();
        assert!((commitment.into_scalar::<f32>() - left - last).abs() < 1e-6);
    }

    #[test]
    fn a_code_that_nobody_takes_stays_finite() {
        let mut codes = vec![1.0, 2.0];
        let mut sums = vec![0.0, 2.0];
        let mut counts = vec![0.0, 1.0];
        let mut book = Book { codes: &mut codes, sums: &mut sums, counts: &mut counts, decay: 0.99 };
        book.update_remembering(&[0.0, 0.0], &[0.0, 0.0], &[7.0, 7.0], &mut [0.0, 0.0], &mut 0.0);
        assert_eq!(codes[0], 1.0);
        assert!((codes[1] - 2.0).abs() < 1e-6);
    }

    #[test]
    fn few_rows_are_repeated_with_noise_and_many_are_taken_as_they_are() {
        assert_eq!(candidates(&[1.0, 2.0, 3.0], 2, 1, |_| unreachable!("enough rows")), [1.0, 2.0]);
        let tiled = candidates(&[1.0, 2.0], 3, 1, |len| vec![1.0; len]);
        assert_eq!(tiled, [1.01, 2.01, 1.01]);
    }
}
