# %% [markdown]
# # A model from a notebook
#
# A server, a run, its curve, a registered version, and motions that play below. The server runs elsewhere: `STRIDE_SERVER` is its
# address and `STRIDE_TOKEN` the token. This notebook was executed against a server with one worker.
# %%
from pathlib import Path

import stride

server = stride.connect()
# %% [markdown]
# A pipeline is a YAML file. This one takes seconds, so its motions are no walk yet; `configs/quickstart.yaml` takes minutes
# and walks.
# %%
PIPELINE = """
name: notebook
seed: 1
dataset: {format: synthetic, clips: 32, val: 0.1, test: 0.2}
stages:
  vae:
    kind: train.vae
    latent: {tokens: 2, dim: 8}
    network: {width: 16, layers: 3, heads: 2, feed_forward: 32}
    steps: 20
    batch: {global: 4, slices: 1}
    lr: 2e-3
    warmup: 5
  latents: {kind: encode.latents, vae: vae}
  mld:
    kind: train.mld
    network: {width: 16, layers: 3, heads: 2, feed_forward: 32}
    steps: 20
    batch: {global: 4, slices: 1}
    lr: 2e-3
    warmup: 5
  fid: {kind: evaluate.latent_fid, model: mld, sampler: {steps: 2, guidance: 3}, repeats: 1, components: 4}
  release: {kind: register, model: notebook, from: [mld], promote: {to: prod}}
"""
Path("notebook.yaml").write_text(PIPELINE)
run = server.submit("notebook.yaml")
for event in run.follow():
    if event.kind in ("submitted", "finished", "failed", "ended"):
        print(event.kind, event.stage or "")
# %% [markdown]
# Every value that was recorded, as a series. Nothing is sampled.
# %%
loss = run.metrics("loss", stage="vae").to_pandas()
loss.iloc[[0, len(loss) // 2, -1]].round(3)
# %% [markdown]
# The run has registered a version and moved the alias `prod` to it. A worker draws with it. The array has metres as
# `[motions, frames, joints, 3]`.
# %%
motions = server.model("notebook@prod").generate("a person walks in a circle", n=2, seconds=2)
print(motions.dtype, motions.shape)
motions
