//! One distillation step against the fixtures `03_distill_*`.
