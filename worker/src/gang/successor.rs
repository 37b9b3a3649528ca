//! The generations that come after one, for threads that outlive it.

use std::sync::{Arc, OnceLock, Weak};

use protocol::Generation;

/// The generation after one, once its orders have come.
#[derive(Debug)]
pub(super) struct Successor<Mesh>(OnceLock<Next<Mesh>>);

#[derive(Debug)]
pub(super) struct Next<Mesh> {
    pub(super) generation: Generation,
    pub(super) mesh: Weak<Mesh>,
    /// Outlives the mesh, so that the generations after it are found.
    pub(super) successor: Arc<Successor<Mesh>>,
}

impl<Mesh> Default for Successor<Mesh> {
    fn default() -> Self {
        Self(OnceLock::new())
    }
}

impl<Mesh> Successor<Mesh> {
    /// Names the next generation; the first one counts.
    pub(super) fn set(&self, next: Next<Mesh>) {
        let _ = self.0.set(next);
    }

    pub(super) fn get(&self) -> Option<&Next<Mesh>> {
        self.0.get()
    }

    /// The meshes of all later generations that still exist.
    pub(super) fn all(&self) -> Vec<Arc<Mesh>> {
        std::iter::successors(self.get(), |next| next.successor.get()).filter_map(|next| next.mesh.upgrade()).collect()
    }
}
