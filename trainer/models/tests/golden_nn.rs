//! Transformer layers against PyTorch's.
