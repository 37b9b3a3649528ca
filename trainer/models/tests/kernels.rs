//! The fused kernels against Burn's operations and against differences of their own values, forward and backward.
#![cfg(feature = "flex")]

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::flat;
use models::kernels::{self, Derivative, Dropout, KeyMask, Sweep, stock};
use models::networks::{BiGru, EvaluatorConfig, Init, Linear, MovementDecoder, MovementEncoder};
use motion::skeleton::Skeleton;
use protocol::Seed;
use protocol::stage::{DataFormat, Positions};

/// Smooth, distinct values of either sign.
fn wave(count: usize, seed: usize) -> Vec<f32> {
    (0..count).map(|i| ((i * 7 + seed * 31) as f32 * 0.731).sin() * 1.5 + ((i + seed) as f32 * 0.013).cos()).collect()
}

fn tensor<const D: usize>(shape: [usize; D], seed: usize, device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(wave(shape.iter().product(), seed), shape), device)
}

fn leaf<const D: usize>(shape: [usize; D], seed: usize) -> Tensor<D> {
    tensor(shape, seed, &Device::flex().autodiff()).require_grad()
}

fn values<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().as_slice::<f32>().expect("f32").to_vec()
}

/// A loss of `out` with fixed weights, whose gradient differs for every element.
fn weighted<const D: usize>(out: Tensor<D>) -> Tensor<1> {
    let weights = tensor(out.dims(), 5, &out.device().inner());
    (out * weights).sum()
}

/// Compares results of a kernel with those of the operations it replaces: each list within `tolerance` of its largest value.
fn agree(name: &str, tolerance: f32, run: impl Fn() -> Vec<Vec<f32>>) {
    let (fused, plain) = (run(), stock(&run));
    assert_eq!(fused, run(), "{name}: the same bits again");
    assert_eq!(fused.len(), plain.len());
    for (part, (f, p)) in fused.iter().zip(&plain).enumerate() {
        assert_eq!(f.len(), p.len(), "{name}, part {part}");
        let scale = p.iter().fold(1e-3_f32, |m, v| m.max(v.abs()));
        let worst = f.iter().zip(p).fold(0.0_f32, |m, (f, p)| m.max((f - p).abs())) / scale;
        assert!(worst <= tolerance, "{name}, part {part}: {worst:.1e} > {tolerance:.0e}");
    }
}

/// The slope of `loss` along each listed element of `at`, by central differences, against `gradient`.
fn slopes(name: &str, at: &[f32], gradient: &[f32], loss: impl Fn(&[f32]) -> f64) {
    let scale = gradient.iter().fold(0.0_f32, |m, v| m.max(v.abs()));
    let h = 1e-2_f32;
    for i in (0..at.len()).step_by((at.len() / 40).max(1)) {
        let mut moved = at.to_vec();
        moved[i] = at[i] + h;
        let up = loss(&moved);
        moved[i] = at[i] - h;
        let slope = ((up - loss(&moved)) / f64::from(2.0 * h)) as f32;
        assert!((slope - gradient[i]).abs() < 5e-3 * scale, "{name}, element {i}: {} against {slope}", gradient[i]);
    }
}

fn sum(values: &[f32], weights: &[f32]) -> f64 {
    values.iter().zip(weights).map(|(v, w)| f64::from(*v) * f64::from(*w)).sum()
}

#[test]
fn linear_is_the_stock_linear() {
    for (rows, inner, out) in [(1, 1, 1), (5, 3, 7), (67, 128, 256), (33, 263, 128)] {
        for biased in [true, false] {
            agree(&format!("linear {rows}x{inner}->{out}, bias {biased}"), 2e-6, || {
                let (x, w, b) = (leaf([2, rows, inner], 1), leaf([out, inner], 2), leaf([out], 3));
                let y = kernels::linear(x.clone(), w.clone(), biased.then(|| b.clone()));
                let gradients = weighted(y.clone()).backward();
                let mut all = vec![values(y), values(x.grad(&gradients).unwrap()), values(w.grad(&gradients).unwrap())];
                all.extend(biased.then(|| values(b.grad(&gradients).unwrap())));
                all
            });
        }
    }
}

/// Value, and gradients of the inputs, of `run` on leaves.
fn with_gradients<const N: usize>(leaves: [Tensor<3>; N], run: impl Fn([Tensor<3>; N]) -> Tensor<3>) -> Vec<Vec<f32>> {
    let out = run(leaves.clone());
    let gradients = weighted(out.clone()).backward();
    std::iter::once(values(out))
        .chain(leaves.map(|x| values(x.grad(&gradients).expect("a leaf has a gradient"))))
        .collect()
}

#[test]
fn convolutions_are_the_stock_convolutions() {
    // Frames, in, out, taps, and how the window moves.
    for (frames, inner, out, taps, stride, dilation, padding) in [
        (1, 1, 1, 1, 1, 1, 0),
        (9, 5, 7, 1, 1, 1, 0),
        (16, 6, 4, 3, 1, 1, 1),
        (16, 6, 4, 3, 1, 9, 9),
        (7, 6, 4, 3, 1, 3, 3),
        (12, 5, 8, 4, 2, 1, 1),
        (13, 5, 8, 3, 2, 1, 1),
        (3, 4, 3, 5, 1, 1, 2),
        (11, 4, 3, 5, 3, 2, 4),
    ] {
        let sweep = Sweep { stride, dilation, padding };
        for biased in [true, false] {
            agree(&format!("{frames} frames, {inner}x{taps}->{out}, {sweep:?}, bias {biased}"), 3e-6, || {
                let leaves = [leaf([2, frames, inner], 1), leaf([out, inner, taps], 2), leaf([1, 1, out], 3)];
                with_gradients(leaves, |[x, w, b]| {
                    let bias = b.reshape([out]);
                    let y = kernels::conv(x, w, biased.then(|| bias.clone()), sweep);
                    if biased { y } else { y + bias.reshape([1, 1, out]) }
                })
            });
        }
        agree(&format!("transposed, {frames} frames, {inner}x{taps}->{out}, {sweep:?}"), 3e-6, || {
            let leaves = [leaf([2, frames, inner], 1), leaf([inner, out, taps], 2), leaf([1, 1, out], 3)];
            with_gradients(leaves, |[x, w, b]| kernels::transposed_conv(x, w, b.reshape([out]), sweep))
        });
    }
}

#[test]
fn dropout_and_leaky_relu_are_the_stock_ones() {
    for slope in [0.0, 0.2] {
        agree(&format!("leaky ReLU of slope {slope} after dropout"), 1e-6, || {
            with_gradients([leaf([3, 7, 33], 1)], |[x]| {
                let y = kernels::dropout(x.clone() * 2.0, &mut Dropout::new(0.3, 5, 1, 2));
                kernels::leaky_relu(y, slope) + x
            })
        });
    }
}

#[test]
fn norms_before_a_silu_are_the_stock_norms() {
    for (frames, width) in [(1, 2), (5, 7), (16, 96)] {
        for changed in [true, false] {
            agree(&format!("{frames} frames of {width}, scale and shift {changed}"), 5e-6, || {
                let leaves = [leaf([2, frames, width], 1), leaf([1, 1, width], 2), leaf([1, 2, 2 * width], 3)];
                with_gradients(leaves, |[x, gain, change]| {
                    let change = change.reshape([2, 2 * width]);
                    let y = kernels::rms_norm_silu(x, gain.reshape([width]), changed.then(|| change.clone()));
                    if changed { y } else { y + change.sum().reshape([1, 1, 1]) }
                })
            });
        }
    }
}

#[test]
fn views_are_read_where_they_lie() {
    agree("linear on a transposed, narrowed view", 2e-6, || {
        let (x, w) = (leaf([4, 9, 6], 1), leaf([5, 6], 2));
        let view = x.clone().swap_dims(0, 1).slice([2..7, 1..3, 0..6]);
        let weight = w.clone().slice([1..4, 0..6]);
        let y = kernels::gelu(kernels::linear(view, weight, None));
        let gradients = weighted(y.clone()).backward();
        vec![values(y), values(x.grad(&gradients).unwrap()), values(w.grad(&gradients).unwrap())]
    });
    agree("norm and attention on an expanded view", 2e-6, || {
        let (x, gamma, beta) = (leaf([1, 6, 24], 1), leaf([24], 2), leaf([24], 3));
        let wide = x.clone().expand([3, 6, 24]);
        let y = kernels::layer_norm(wide.clone(), gamma.clone(), beta, 1e-5);
        let y = kernels::self_attention(y, 2, None, &mut Dropout::off());
        let gradients = weighted(y.clone()).backward();
        vec![values(y), values(x.grad(&gradients).unwrap()), values(gamma.grad(&gradients).unwrap())]
    });
}

#[test]
fn gelu_is_the_stock_gelu() {
    agree("gelu", 8e-7, || {
        let far: Vec<f32> = (-600..600).map(|i| i as f32 * 0.02).collect();
        let x = Tensor::<1>::from_data(TensorData::new(far, [1200]), &Device::flex().autodiff()).require_grad();
        let y = kernels::gelu(x.clone());
        let gradients = weighted(y.clone()).backward();
        vec![values(y), values(x.grad(&gradients).unwrap())]
    });
}

#[test]
fn mish_is_the_stock_mish() {
    // The composed gradient is a difference of near numbers where x is large.
    agree("mish", 1e-5, || {
        let far: Vec<f32> = (-600..1600).map(|i| i as f32 * 0.02).collect();
        let x = Tensor::<1>::from_data(TensorData::new(far, [2200]), &Device::flex().autodiff()).require_grad();
        let y = kernels::mish(x.clone());
        let gradients = weighted(y.clone()).backward();
        vec![values(y), values(x.grad(&gradients).unwrap())]
    });
    let plain = |x: f32| values(kernels::mish(Tensor::<1>::from_floats([x], &Device::flex())))[0];
    for x in [-20.0_f64, -3.0, -0.5, 0.0, 0.5, 3.0, 20.0, 500.0] {
        let expected = x * x.exp().ln_1p().min(1e3).tanh();
        assert!((f64::from(plain(x as f32)) - expected).abs() < 1e-6 * (1.0 + x.abs()), "mish({x})");
    }
}

#[test]
fn norms_are_the_stock_norms() {
    for (rows, width) in [(1, 1), (3, 5), (40, 128), (17, 263)] {
        for residual in [false, true] {
            agree(&format!("norm {rows}x{width}, residual {residual}"), 8e-6, || {
                let (x, y) = (leaf([2, rows, width], 1), leaf([2, rows, width], 2));
                let (gamma, beta) = (leaf([width], 3), leaf([width], 4));
                let out = if residual {
                    kernels::add_layer_norm(x.clone(), y.clone(), gamma.clone(), beta.clone(), 1e-5)
                } else {
                    kernels::layer_norm(x.clone(), gamma.clone(), beta.clone(), 1e-5)
                };
                let gradients = weighted(out.clone()).backward();
                let mut all = vec![values(out)];
                // With a single column the input's gradient is only rounding error.
                if width > 1 {
                    all.push(values(x.grad(&gradients).unwrap()));
                    all.extend(residual.then(|| values(y.grad(&gradients).unwrap())));
                }
                all.extend([gamma, beta].map(|p| values(p.grad(&gradients).unwrap())));
                all
            });
        }
    }
}

#[test]
fn leaky_norms_are_the_stock_norms() {
    for (rows, width) in [(3, 5), (40, 96), (17, 263)] {
        for residual in [false, true] {
            agree(&format!("leaky norm {rows}x{width}, residual {residual}"), 8e-6, || {
                let (x, y) = (leaf([2, rows, width], 1), leaf([2, rows, width], 2));
                let (gamma, beta) = (leaf([width], 3), leaf([width], 4));
                let onto = residual.then(|| y.clone());
                let out = kernels::leaky_layer_norm(x.clone(), onto, gamma.clone(), beta.clone(), 1e-5, 0.01);
                let gradients = weighted(out.clone()).backward();
                let mut all = vec![values(out), values(x.grad(&gradients).unwrap())];
                all.extend(residual.then(|| values(y.grad(&gradients).unwrap())));
                all.extend([gamma, beta].map(|p| values(p.grad(&gradients).unwrap())));
                all
            });
        }
    }
}

#[test]
fn a_leaky_norm_has_the_bits_of_its_parts() {
    let run = |whole: bool| {
        let (x, y) = (leaf([2, 9, 96], 1), leaf([2, 9, 96], 2));
        let (gamma, beta) = (leaf([96], 3), leaf([96], 4));
        let out = if whole {
            kernels::leaky_layer_norm(x.clone(), Some(y.clone()), gamma.clone(), beta.clone(), 1e-5, 0.2)
        } else {
            let norm = kernels::layer_norm(x.clone(), gamma.clone(), beta.clone(), 1e-5);
            y.clone() + burn::tensor::activation::leaky_relu(norm, 0.2)
        };
        let gradients = weighted(out.clone()).backward();
        let [gamma, beta] = [gamma, beta].map(|p| values(p.grad(&gradients).unwrap()));
        [values(out), values(x.grad(&gradients).unwrap()), values(y.grad(&gradients).unwrap()), gamma, beta]
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn gradients_that_are_shared_stay_whole() {
    // The gradient of a residual norm goes to both of its inputs; what one makes of it must not reach the other.
    agree("a residual norm of two activations", 8e-6, || {
        let (x, y) = (leaf([2, 7, 24], 1), leaf([2, 7, 24], 2));
        let (gamma, beta) = (leaf([24], 3), leaf([24], 4));
        let out = kernels::add_layer_norm(kernels::gelu(x.clone()), kernels::mish(y.clone()), gamma, beta, 1e-5);
        let gradients = weighted(out.clone() + kernels::gelu(out)).backward();
        vec![values(x.grad(&gradients).unwrap()), values(y.grad(&gradients).unwrap())]
    });
}

/// Batch, items, heads, width of a head: sizes of both ways of computing attention.
const SIZES: [(usize, usize, usize, usize); 7] =
    [(1, 1, 1, 1), (2, 7, 2, 3), (3, 18, 4, 24), (2, 37, 4, 32), (2, 64, 2, 8), (2, 65, 2, 8), (1, 132, 2, 64)];

#[test]
fn attention_is_the_stock_attention() {
    for (batch, len, heads, head) in SIZES {
        let lengths: Vec<usize> = (0..batch).map(|b| len - b.min(len - 1)).collect();
        for (mask, probability) in [(false, 0.0), (true, 0.0), (true, 0.3)] {
            let width = heads * head;
            let name = format!("{batch}x{len}, {heads} heads of {head}, mask {mask}, dropout {probability}");
            let mask = mask.then(|| KeyMask::new(&lengths, 0));
            agree(&format!("self-attention {name}"), 3e-6, || {
                let x = leaf([batch, len, 3 * width], 1);
                let mut dropout = Dropout::new(probability, 9, 2, 1);
                let y = kernels::self_attention(x.clone(), heads, mask.as_ref(), &mut dropout);
                let gradients = weighted(y.clone()).backward();
                vec![values(y), values(x.grad(&gradients).unwrap())]
            });
            agree(&format!("causal attention {name}"), 3e-6, || {
                let x = leaf([batch, len, 3 * width], 1);
                let mut dropout = Dropout::new(probability, 9, 2, 1);
                let y = kernels::causal_attention(x.clone(), heads, &mut dropout);
                let gradients = weighted(y.clone()).backward();
                vec![values(y), values(x.grad(&gradients).unwrap())]
            });
            agree(&format!("cross-attention {name}"), 3e-6, || {
                let (q, kv) = (leaf([batch, 5, width], 1), leaf([batch, len, 2 * width], 2));
                let mut dropout = Dropout::new(probability, 9, 2, 1);
                let y = kernels::cross_attention(q.clone(), kv.clone(), heads, mask.as_ref(), &mut dropout);
                let gradients = weighted(y.clone()).backward();
                vec![values(y), values(q.grad(&gradients).unwrap()), values(kv.grad(&gradients).unwrap())]
            });
        }
    }
}

#[test]
fn a_sequence_has_the_same_bits_in_any_company() {
    for (batch, len, heads, head) in SIZES {
        let (triple, lengths) = (3 * heads * head, [len, 1, len.div_ceil(2)]);
        let run = |from: usize, count: usize| {
            let mask = KeyMask::new(&lengths[from..from + count], 0);
            let all = wave(3 * len * triple, 1);
            let own = all[from * len * triple..(from + count) * len * triple].to_vec();
            let x = Tensor::<3>::from_data(TensorData::new(own, [count, len, triple]), &Device::flex().autodiff());
            let x = x.require_grad();
            let y = kernels::self_attention(x.clone(), heads, Some(&mask), &mut Dropout::off());
            let gradients = (y.clone() * y.clone()).sum().backward();
            (values(y), values(x.grad(&gradients).unwrap()))
        };
        let (out, gradient) = run(0, 3);
        let alone: Vec<_> = (0..3).map(|b| run(b, 1)).collect();
        let name = format!("{batch}x{len}, {heads} heads of {head}");
        assert_eq!(out, alone.iter().flat_map(|(y, _)| y.clone()).collect::<Vec<_>>(), "{name}");
        assert_eq!(gradient, alone.iter().flat_map(|(_, g)| g.clone()).collect::<Vec<_>>(), "{name}");
    }
}

#[test]
fn padding_reaches_nothing() {
    let mask = KeyMask::new(&[2, 5], 1);
    let run = |junk: f32| {
        let mut x = wave(2 * 6 * 24, 1);
        x[3 * 24..6 * 24].fill(junk);
        let x = Tensor::<3>::from_data(TensorData::new(x, [2, 6, 24]), &Device::flex().autodiff()).require_grad();
        let y = kernels::self_attention(x.clone(), 2, Some(&mask), &mut Dropout::off());
        // Rows of padding are undefined; the loss leaves them out.
        let live = Tensor::cat(vec![y.clone().slice([0..1, 0..3, 0..8]), y.slice([1..2, 0..3, 0..8])], 0);
        let gradients = weighted(live.clone()).backward();
        (values(live), values(x.grad(&gradients).unwrap())[3 * 24..6 * 24].to_vec())
    };
    let ((a, gradient), (b, _)) = (run(0.5), run(-3.0));
    assert_eq!(a, b);
    assert!(gradient.iter().all(|g| *g == 0.0), "a gradient reaches padding");
}

#[test]
fn gradients_are_slopes() {
    let plain = Device::flex();
    let weights = wave(2 * 5 * 8, 5);
    let mask = KeyMask::new(&[5, 3], 0);
    let attention = |x: Tensor<3>| kernels::self_attention(x, 2, Some(&mask), &mut Dropout::new(0.2, 1, 1, 1));
    let x = leaf([2, 5, 24], 1);
    let found = values(x.grad(&weighted(attention(x.clone())).backward()).unwrap());
    slopes("attention", &wave(240, 1), &found, |at| {
        sum(&values(attention(Tensor::from_data(TensorData::new(at.to_vec(), [2, 5, 24]), &plain))), &weights)
    });

    let norm = |x: Tensor<3>| {
        let device = x.device();
        kernels::add_layer_norm(
            x,
            tensor([2, 5, 8], 2, &device),
            tensor([8], 3, &device),
            tensor([8], 4, &device),
            1e-5,
        )
    };
    let x = leaf([2, 5, 8], 1);
    let found = values(x.grad(&weighted(norm(x.clone())).backward()).unwrap());
    slopes("norm", &wave(80, 1), &found, |at| {
        sum(&values(norm(Tensor::from_data(TensorData::new(at.to_vec(), [2, 5, 8]), &plain))), &weights)
    });

    let x = leaf([2, 5, 8], 1);
    let found = values(x.grad(&weighted(kernels::mish(x.clone())).backward()).unwrap());
    slopes("mish", &wave(80, 1), &found, |at| {
        sum(&values(kernels::mish(Tensor::<3>::from_data(TensorData::new(at.to_vec(), [2, 5, 8]), &plain))), &weights)
    });

    let x = leaf([2, 5, 8], 1);
    let found = values(x.grad(&weighted(kernels::gelu(x.clone())).backward()).unwrap());
    slopes("gelu", &wave(80, 1), &found, |at| {
        sum(&values(kernels::gelu(Tensor::<3>::from_data(TensorData::new(at.to_vec(), [2, 5, 8]), &plain))), &weights)
    });
}

#[test]
fn values_do_not_depend_on_the_tape() {
    let run = |device: &Device| {
        let x = tensor([2, 9, 24], 1, device);
        let y = kernels::linear(x.clone(), tensor([72, 24], 2, device), Some(tensor([72], 3, device)));
        let y = kernels::self_attention(y, 4, Some(&KeyMask::new(&[9, 4], 0)), &mut Dropout::new(0.1, 3, 4, 5));
        let y = kernels::add_layer_norm(x, y, tensor([24], 6, device), tensor([24], 7, device), 1e-5);
        values(kernels::gelu(y))
    };
    assert_eq!(run(&Device::flex()), run(&Device::flex().autodiff()));
}

#[test]
fn constants_take_no_part() {
    // A frozen network under a tape: its parameters get no gradient, but its inputs do.
    let x = leaf([1, 4, 6], 1);
    let weight = tensor([6, 6], 2, &Device::flex());
    let y = kernels::linear(x.clone(), weight, None);
    let gradients = weighted(y).backward();
    assert!(x.grad(&gradients).is_some());
    let y = kernels::linear(tensor::<3>([1, 4, 6], 1, &Device::flex()), leaf([6, 6], 2), None);
    weighted(y).backward();
}

#[test]
fn dropout_is_a_function_of_its_place() {
    let device = Device::flex();
    let draw = |seed, step, slice, layer: usize| {
        let mut dropout = Dropout::new(0.25, seed, step, slice);
        let ones = || Tensor::<2>::ones([64, 64], &device);
        for _ in 0..layer {
            kernels::dropout(ones(), &mut dropout);
        }
        values(kernels::dropout(ones(), &mut dropout))
    };
    let base = draw(1, 2, 3, 0);
    assert_eq!(base, draw(1, 2, 3, 0));
    for other in [draw(2, 2, 3, 0), draw(1, 3, 3, 0), draw(1, 2, 4, 0), draw(1, 2, 3, 1)] {
        assert_ne!(base, other);
    }
    let kept = base.iter().filter(|v| **v > 0.0).count() as f64 / base.len() as f64;
    assert!((kept - 0.75).abs() < 0.03, "kept {kept}");
    assert!(base.iter().all(|v| *v == 0.0 || (*v - 1.0 / 0.75).abs() < 1e-6));
    assert_eq!(values(kernels::dropout(tensor::<1>([9], 1, &device), &mut Dropout::off())), wave(9, 1));
}

#[test]
fn gru_is_the_stock_gru() {
    for (batch, tokens, width, lengths) in [(1, 1, 1, vec![1]), (3, 7, 5, vec![7, 1, 4]), (2, 4, 33, vec![0, 3])] {
        for reverse in [false, true] {
            agree(&format!("gru {batch}x{tokens}x{width}, reverse {reverse}"), 3e-6, || {
                let (a, h) = (leaf([batch, tokens, 3 * width], 1), leaf([batch, width], 2));
                let (w, c) = (leaf([3 * width, width], 3), leaf([3 * width], 4));
                let w_small = w.clone() * 0.3;
                let y = kernels::gru(a.clone(), h.clone(), w_small, c.clone(), &lengths, reverse);
                let gradients = weighted(y.clone()).backward();
                vec![
                    values(y),
                    values(a.grad(&gradients).unwrap()),
                    values(h.grad(&gradients).unwrap()),
                    values(w.grad(&gradients).unwrap()),
                    values(c.grad(&gradients).unwrap()),
                ]
            });
        }
    }
    let lengths = [3, 2];
    let run = |a: &[f32]| {
        let plain = Device::flex();
        let a = Tensor::from_data(TensorData::new(a.to_vec(), [2, 3, 12]), &plain);
        let y = kernels::gru(
            a,
            tensor([2, 4], 2, &plain),
            tensor([12, 4], 3, &plain),
            tensor([12], 4, &plain),
            &lengths,
            true,
        );
        sum(&values(y), &wave(24, 5))
    };
    let a = leaf([2, 3, 12], 1);
    let plain = Device::flex();
    let y = kernels::gru(
        a.clone(),
        tensor([2, 4], 2, &plain),
        tensor([12, 4], 3, &plain),
        tensor([12], 4, &plain),
        &lengths,
        true,
    );
    let gradient = values(a.grad(&weighted(y).backward()).unwrap());
    slopes("gru", &wave(72, 1), &gradient, run);
    assert!(gradient[(3 + 2) * 12..].iter().all(|g| *g == 0.0), "what is behind the end has no part");
}

#[test]
fn distances_are_the_stock_distances() {
    for distance in [kernels::Pointwise::SmoothL1, kernels::Pointwise::L1, kernels::Pointwise::L2] {
        agree(&format!("{distance:?}"), 2e-6, || {
            let (found, expected) = (leaf([3, 5, 37], 1), leaf([3, 5, 37], 2));
            let weights = tensor([3, 5, 1], 3, &Device::flex());
            let out = kernels::weighted_distance(distance, found.clone(), expected.clone(), weights);
            let gradients = weighted(out.clone()).backward();
            vec![values(out), values(found.grad(&gradients).unwrap()), values(expected.grad(&gradients).unwrap())]
        });
    }
}

#[test]
fn joints_and_their_derivatives_are_the_stock_ones() {
    for format in [DataFormat::Humanml3d, DataFormat::Kit] {
        let skeleton = Skeleton::of(format);
        for frames in [1, 2, 33] {
            agree(&format!("joints of {frames} frames"), 5e-6, || {
                let width = skeleton.features;
                let x = leaf([3, frames, width], 1);
                let (mean, std) =
                    (tensor([1, 1, width], 2, &Device::flex()), tensor([1, 1, width], 3, &Device::flex()));
                let joints = kernels::joints(x.clone(), mean * 0.1, std * 0.1, 1.7, skeleton);
                let mut all = vec![values(joints.clone())];
                let mut loss = weighted(joints.clone());
                for derivative in [Derivative::Velocity, Derivative::Acceleration] {
                    if frames > derivative.order() {
                        let change = kernels::joint_derivative(joints.clone(), &[7, 0, 10], derivative, 20.0);
                        all.push(values(change.clone()));
                        loss = loss + weighted(change) * 0.05;
                    }
                }
                all.push(values(x.grad(&loss.backward()).unwrap()));
                all
            });
        }
    }
}

#[test]
fn gradients_that_are_collected_are_those_of_the_tape() {
    let device = Device::flex().autodiff();
    let mut init = Init::new(Seed(3), "collected", Positions::Uniform, &device);
    let layers: Vec<Linear> = (0..4).map(|_| Linear::new(&mut init, 5, 5)).collect();
    // The first has two uses, the second none, the third one on the tape of Burn, and the last one of each.
    let loss = || {
        let x = layers[0].forward(layers[0].forward(tensor([3, 5], 1, &device)));
        let x = layers[3].forward(x).matmul(layers[2].weight.val())
            * layers[3].bias.as_ref().expect("a bias").val().unsqueeze();
        weighted(x)
    };
    let tape = flat::take_gradients(&layers, &mut loss().backward());
    // The content of memory that is used again does not matter.
    flat::recycle(vec![f32::NAN; layers.num_params()]);
    let collected = flat::gradient(&layers, loss());
    assert_eq!(collected, tape);
    let of_layer = tape.len() / 4;
    assert!(tape[of_layer..2 * of_layer].iter().all(|g| *g == 0.0));
    assert!(tape[..of_layer].iter().chain(&tape[3 * of_layer..]).all(|g| *g != 0.0));
}

#[test]
fn collected_gradients_of_convolutions_and_recurrent_units_are_those_of_the_tape() {
    let device = Device::flex().autodiff();
    let mut init = Init::new(Seed(4), "collected", Positions::Uniform, &device);
    let config = EvaluatorConfig {
        features: 6,
        movement_hidden: 5,
        movement: 4,
        motion_hidden: 4,
        word: 1,
        classes: 1,
        text_hidden: 1,
        embedding: 1,
    };
    let encoder = MovementEncoder::new(&config, &mut init);
    let decoder = MovementDecoder::new(&config, 6, &mut init);
    let network = (encoder, decoder, BiGru::new(&mut init, 4, 4));
    // The encoder has two uses.
    let loss = || {
        let (encoder, decoder, gru) = &network;
        let encode = |x: Tensor<3>| encoder.forward(x, &mut Dropout::off());
        let x = encode(decoder.forward(encode(tensor([2, 16, 6], 1, &device))));
        let start = [2, 3].map(|seed| tensor([2, 4], seed, &device));
        let [ahead, back] = gru.forward(x, &[4, 3], start);
        weighted(ahead) + weighted(back) * 0.5
    };
    let tape = flat::take_gradients(&network, &mut loss().backward());
    flat::recycle(vec![f32::NAN; network.num_params()]);
    let collected = flat::gradient(&network, loss());
    assert_eq!(collected, tape);
    assert!(tape.iter().filter(|g| **g != 0.0).count() > tape.len() * 9 / 10);
}
