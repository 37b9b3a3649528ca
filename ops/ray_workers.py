"""Starts workers of a server as actors of a Ray cluster, until Ctrl-C or SIGTERM; then each saves and leaves.

    python ops/ray_workers.py --workers 4 --gpus 1 URL --token-file FILE --ca FILE

All other options are passed to `trainer worker join`. The program and the files are at the same paths on all nodes.
"""

import argparse
import signal
import subprocess

import ray


# Ray starts a lost actor again. The worker of an actor is killed with it.
@ray.remote(max_restarts=-1, max_task_retries=-1, max_concurrency=2)
class Worker:
    def __init__(self):
        self.process = None

    def work(self, command):
        self.process = subprocess.Popen(command)
        return self.process.wait()

    def leave(self):
        if self.process:
            self.process.terminate()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--cpus", type=float, default=1, help="of each worker")
    parser.add_argument("--gpus", type=float, default=0, help="of each worker")
    parser.add_argument("--program", default="trainer")
    options, join = parser.parse_known_args()
    ray.init()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    workers = [Worker.options(num_cpus=options.cpus, num_gpus=options.gpus).remote() for _ in range(options.workers)]
    command = [options.program, "worker", "join", "--die-with-parent", *join]
    ends = [worker.work.remote(command) for worker in workers]
    try:
        statuses = ray.get(ends)
    except KeyboardInterrupt:
        leaving = [worker.leave.remote() for worker in workers]
        # An actor for which the cluster has no place has not started, and has no worker.
        ended, _ = ray.wait(ends, num_returns=len(leaving), timeout=60)
        statuses = ray.get(ended)
    return int(any(statuses))


if __name__ == "__main__":
    raise SystemExit(main())
