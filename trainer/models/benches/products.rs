//! Rates of the products of linear layers: the output, and the gradients of input and weight. `trainer/benches/products.py`
//! runs it beside PyTorch.
//!
//! Prints rows, inputs and outputs of each layer, and billions of operations a second of each product, from the least of
//! 15 times. The work of the tape counts too.
#![expect(clippy::print_stdout, reason = "a bench prints what it measured")]

use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use models::{device, kernels};
use protocol::stage::Backend;

const TIMES: usize = 15;

/// Rows, inputs, outputs: the quickstart's denoiser, MotionLCM, the tokenizer of MoMask, T2M-GPT.
const LAYERS: [[usize; 3]; 8] = [
    [576, 96, 192],
    [576, 192, 96],
    [400, 256, 1024],
    [400, 1024, 256],
    [512, 1536, 512],
    [408, 1024, 1024],
    [408, 1024, 4096],
    [408, 4096, 1024],
];

fn tensor<const D: usize>(shape: [usize; D], device: &Device) -> Tensor<D> {
    let values: Vec<f32> = (0..shape.iter().product()).map(|i| (i as f32 * 0.37).sin()).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// The least time in seconds that work of `make` takes.
fn least<F: FnOnce()>(mut make: impl FnMut() -> F) -> f64 {
    let time = |work: F| {
        let start = Instant::now();
        work();
        start.elapsed().as_secs_f64()
    };
    (0..TIMES).map(|_| time(make())).fold(f64::INFINITY, f64::min)
}

fn main() {
    let plain = device::open(Backend::Flex, 0).expect("built with flex");
    let tracked = plain.clone().autodiff();
    for [rows, inputs, outputs] in LAYERS {
        let (x, w) = (tensor([rows, inputs], &plain), tensor([outputs, inputs], &plain));
        let forward = least(|| {
            || {
                kernels::linear(x.clone(), w.clone(), None);
            }
        });
        // The tape of one operand computes one product; the loss is the sum, whose gradient is 1 everywhere.
        let (tracked_x, tracked_w) = (tensor([rows, inputs], &tracked), tensor([outputs, inputs], &tracked));
        let input = least(|| {
            let loss = kernels::linear(tracked_x.clone().require_grad(), tracked_w.clone(), None).sum();
            move || drop(loss.backward())
        });
        let weight = least(|| {
            let loss = kernels::linear(tracked_x.clone(), tracked_w.clone().require_grad(), None).sum();
            move || drop(loss.backward())
        });
        let rate = |seconds: f64| 2e-9 * (rows * inputs * outputs) as f64 / seconds;
        println!("{rows} {inputs} {outputs} {:.1} {:.1} {:.1}", rate(forward), rate(input), rate(weight));
    }
}
