//! Parameters, moments and average of one optimizer, kept on an accelerator from step to step.
//!
//! The arithmetic is that of [`AdamW`], one Burn operation for each line of its loop. An accelerator may round
//! divisions and roots differently from a CPU, and its compiler may fuse a product and a sum. So the last bits differ
//! from the loop's; on one device they are the same each time.

use burn::tensor::{Device, Tensor, TensorData};

use crate::optim::AdamW;

/// Flat tensors [N] on one device, without autodiff.
#[derive(Debug, Clone)]
pub struct Resident {
    params: Tensor<1>,
    m: Tensor<1>,
    v: Tensor<1>,
    average: Option<Tensor<1>>,
}

/// The same buffers on the host. Moments may be empty for parameters that are not trained.
#[derive(Debug)]
pub struct Host<'a> {
    pub params: &'a mut [f32],
    /// First moments of the parameters.
    pub m: &'a mut [f32],
    /// Second moments of the parameters.
    pub v: &'a mut [f32],
    /// Moving average of the parameters, if one is kept.
    pub average: Option<&'a mut [f32]>,
}

fn send(values: &[f32], device: &Device) -> Tensor<1> {
    Tensor::from_data(TensorData::new(values.to_vec(), [values.len()]), device)
}

fn fetch(from: &Tensor<1>, to: &mut [f32]) {
    let data = from.clone().into_data();
    to.copy_from_slice(data.as_slice::<f32>().expect("kept as f32"));
}

impl Resident {
    /// Copies everything to `device`.
    pub fn send(host: &Host<'_>, device: &Device) -> Self {
        let device = &device.clone().inner();
        // A device keeps no tensor without elements, so missing moments are one unused element.
        let moments =
            |values: &[f32]| if values.is_empty() { Tensor::zeros([1], device) } else { send(values, device) };
        Self {
            params: send(host.params, device),
            m: moments(host.m),
            v: moments(host.v),
            average: host.average.as_ref().map(|average| send(average, device)),
        }
    }

    /// Copies everything to the host.
    ///
    /// # Panics
    /// If a buffer has another length than the one sent.
    pub fn fetch(&self, host: Host<'_>) {
        fetch(&self.params, host.params);
        if !host.m.is_empty() {
            fetch(&self.m, host.m);
            fetch(&self.v, host.v);
        }
        if let (Some(from), Some(to)) = (&self.average, host.average) {
            fetch(from, to);
        }
    }

    /// The current parameters [N].
    pub fn params(&self) -> &Tensor<1> {
        &self.params
    }

    /// The moving average of the parameters, if one is kept.
    pub fn average(&self) -> Option<&Tensor<1>> {
        self.average.as_ref()
    }

    /// Makes update number `t`, counted from 1, with rate `lr` and `factor` times the gradient, as [`AdamW::step`].
    ///
    /// # Panics
    /// If the gradient has another length than the parameters, or `t` is 0.
    pub fn step(&mut self, optimizer: &AdamW, t: u64, lr: f64, gradient: &[f32], factor: f32) {
        assert_eq!(gradient.len(), self.params.dims()[0], "length of the gradient");
        let rates = optimizer.rates(t, lr);
        let g = send(gradient, &self.params.device()).mul_scalar(factor);
        let m = self.m.clone() + (g.clone() - self.m.clone()).mul_scalar(rates.new1);
        let v = self.v.clone().mul_scalar(rates.beta2) + g.square().mul_scalar(rates.new2);
        let down = v.clone().sqrt().mul_scalar(rates.unbias).add_scalar(rates.eps);
        self.params = self.params.clone().mul_scalar(rates.keep) - m.clone().mul_scalar(rates.rate) / down;
        (self.m, self.v) = (m, v);
    }

    /// Moves the average towards the parameters, as [`crate::optim::ema`]. Does nothing if none is kept.
    pub fn follow(&mut self, decay: f64) {
        if let Some(average) = &mut self.average {
            let keep = decay as f32;
            let take = (1.0 - decay) as f32;
            *average = average.clone().mul_scalar(keep) + self.params.clone().mul_scalar(take);
        }
    }

    /// Makes the average a copy of the parameters. Does nothing if none is kept.
    pub fn copy(&mut self) {
        if let Some(average) = &mut self.average {
            *average = self.params.clone();
        }
    }
}
