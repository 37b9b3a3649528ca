"""A member of PyTorch's gloo for `links`: the same lines as `member.rs`, without regrouping.

NAME ADDRESS PARAMETERS COPIES SLICES as arguments; `gang 1 NAME=ADDRESS...` and `run N` by standard input.
"""

import os
import sys
import time
from datetime import timedelta

import torch
import torch.distributed as dist

name, address, parameters = sys.argv[1], sys.argv[2], int(sys.argv[3])
os.environ["GLOO_SOCKET_IFNAME"] = "eth0"
torch.set_num_threads(1)
print("listens", flush=True)
for line in sys.stdin:
    words = line.split()
    if words[0] == "gang":
        members = [word.split("=") for word in words[2:]]
        rank = [member for member, _ in members].index(name)
        dist.init_process_group(
            "gloo",
            init_method=f"tcp://{members[0][1]}",
            rank=rank,
            world_size=len(members),
            timeout=timedelta(seconds=170),
        )
        gradient = torch.randn(parameters, generator=torch.Generator().manual_seed(rank))
        summed = torch.empty_like(gradient)
        dist.barrier()
    elif words[0] == "run":
        took = []
        for _ in range(int(words[1])):
            begun = time.perf_counter()
            summed.copy_(gradient)
            dist.all_reduce(summed)
            took.append(str(round((time.perf_counter() - begun) * 1e6)))
        # Equal for all members if their bits are; without NumPy there is no cheap way to all bytes.
        digest = f"{summed.view(torch.int32).sum(dtype=torch.int64).item() & (2**64 - 1):016x}"
        print("done", ",".join(took), digest, flush=True)
