//! The skeleton of a drawing or animation: parents and sides of joints, frame rate, and unit of length.
//!
//! A [`motion::Skeleton`] is one of the two that features are defined for; a body may be any skeleton, such as that of
//! a recording with fingers.

use motion::Skeleton;

/// Side of the body, which selects a bone's colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// Neither left nor right.
    Middle,
    /// The body's own left.
    Left,
    /// The body's own right.
    Right,
}

/// A skeleton to show. Its axes are y up, right-handed.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// Parent of each joint, which comes before it; a root is its own.
    pub parents: Vec<usize>,
    /// The side of each joint, and so of the bone that ends in it.
    pub sides: Vec<Side>,
    /// The joint on which a head is drawn.
    pub head: Option<usize>,
    /// Frames per second.
    pub fps: f64,
    /// Metres in one unit of the positions.
    pub metres_per_unit: f64,
}

impl Body {
    /// The body of one of the two skeletons that features are defined for.
    pub fn of(skeleton: &Skeleton) -> Self {
        let side = |joint: usize| match joint {
            joint if skeleton.left.contains(&joint) => Side::Left,
            joint if skeleton.right.contains(&joint) => Side::Right,
            _ => Side::Middle,
        };
        let sides: Vec<Side> = (0..skeleton.joints).map(side).collect();
        let mut ends = skeleton.chains.iter().map(|chain| chain[chain.len() - 1]);
        Self {
            parents: skeleton.parents.to_vec(),
            head: ends.find(|joint| sides[*joint] == Side::Middle),
            sides,
            fps: skeleton.fps,
            metres_per_unit: skeleton.metres_per_unit,
        }
    }

    /// Number of joints J.
    pub fn joints(&self) -> usize {
        self.parents.len()
    }

    /// The bones, each as its start joint and its end joint.
    pub fn bones(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.parents
            .iter()
            .copied()
            .enumerate()
            .filter(|(joint, parent)| joint != parent)
            .map(|(j, parent)| (parent, j))
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataFormat;

    use super::*;

    #[test]
    fn both_skeletons_have_a_head_and_two_sides() {
        for (format, head) in [(DataFormat::Humanml3d, "head"), (DataFormat::Kit, "upper_neck")] {
            let skeleton = Skeleton::of(format);
            let body = Body::of(skeleton);
            assert_eq!(body.head.map(|joint| skeleton.names[joint]), Some(head));
            let count = |side| body.sides.iter().filter(|s| **s == side).count();
            assert_eq!((count(Side::Left), count(Side::Right)), (8, 8));
            assert_eq!(body.bones().count(), skeleton.joints - 1);
            assert!(body.bones().all(|(parent, joint)| parent < joint));
        }
    }
}
