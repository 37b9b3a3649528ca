//! `y = x W^T + b`, with W as published checkpoints store it: [out, in].

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::fused;

/// `x` [..., in], `weight` [out, in], `bias` [out] -> [..., out].
pub fn linear<const D: usize>(x: Tensor<D>, weight: Tensor<2>, bias: Option<Tensor<1>>) -> Tensor<D> {
    let shape = x.dims();
    let [out, inner] = weight.dims();
    assert_eq!(shape[D - 1], inner, "linear: input width against weight");
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        return match bias {
            Some(bias) => fused::run(kernel::Linear, [x.into(), weight.into(), bias.into()]),
            None => fused::run(kernel::Linear, [x.into(), weight.into()]),
        };
    }
    let rows = shape.iter().product::<usize>() / inner;
    let y = x.reshape([rows, inner]).matmul(weight.transpose());
    let y = match bias {
        Some(bias) => y + bias.unsqueeze(),
        None => y,
    };
    let mut to = shape;
    to[D - 1] = out;
    y.reshape(to)
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use crate::kernels::fused::{Fused, Places, column_sums, make, shape, slice};
    use crate::kernels::raw::{View, affine, product, product_to};

    /// The product with a weight, and a bias if there are three inputs.
    #[derive(Debug, Clone)]
    pub(super) struct Linear;

    fn forward(x: &FlexTensor, w: &FlexTensor, bias: Option<&FlexTensor>) -> FlexTensor {
        let mut to = shape(x);
        let inner = to[to.len() - 1];
        let x = slice(x);
        let w = slice(w);
        let rows = x.len() / inner;
        let out = w.len() / inner;
        let sizes = (rows, out, inner);
        let y = match bias {
            Some(bias) => affine(sizes, x, View::rows(inner), w, View::rows(inner).t(), slice(bias)),
            None => product(sizes, x, View::rows(inner), w, View::rows(inner).t()),
        };
        *to.last_mut().expect("an axis of inputs") = out;
        make(y, &to)
    }

    /// The gradients of input and weight; the weight's is written to its place if there is one.
    fn backward(
        x: &FlexTensor,
        w: &FlexTensor,
        dy: &[f32],
        wanted: [bool; 2],
        place: Option<&mut [f32]>,
    ) -> [Option<FlexTensor>; 2] {
        let to = shape(x);
        let weight = shape(w);
        let inner = to[to.len() - 1];
        let x = slice(x);
        let w = slice(w);
        let rows = x.len() / inner;
        let out = w.len() / inner;
        let wide = View::rows(inner);
        let narrow = View::rows(out);
        let dx = || make(product((rows, inner, out), dy, narrow, w, wide), &to);
        let dw = || product_to((out, inner, rows), dy, narrow.t(), x, wide, place).map(|dw| make(dw, &weight));
        [wanted[0].then(dx), wanted[1].then(dw).flatten()]
    }

    impl Fused<2> for Linear {
        type Kept = (FlexTensor, FlexTensor);

        fn forward(&self, [x, w]: [FlexTensor; 2]) -> (FlexTensor, Self::Kept) {
            (forward(&x, &w, None), (x, w))
        }

        fn backward_to(
            &self,
            (x, w): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 2],
            [_, place]: Places<'_, 2>,
        ) -> [Option<FlexTensor>; 2] {
            backward(&x, &w, slice(&dy), wanted, place)
        }
    }

    impl Fused<3> for Linear {
        type Kept = (FlexTensor, FlexTensor);

        fn forward(&self, [x, w, bias]: [FlexTensor; 3]) -> (FlexTensor, Self::Kept) {
            (forward(&x, &w, Some(&bias)), (x, w))
        }

        fn backward_to(
            &self,
            (x, w): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 3],
            [_, of_weight, of_bias]: Places<'_, 3>,
        ) -> [Option<FlexTensor>; 3] {
            let dy = slice(&dy);
            let [dx, dw] = backward(&x, &w, dy, [wanted[0], wanted[1]], of_weight);
            let bias = || column_sums(dy, shape(&w)[0], of_bias);
            [dx, dw, wanted[2].then(bias).flatten()]
        }
    }
}
