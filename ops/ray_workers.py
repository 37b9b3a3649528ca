"""Starts workers of a server as actors of a Ray cluster, until Ctrl-C or SIGTERM; then each saves and leaves.

    python ops/ray_workers.py --workers 4 --gpus 1 URL --token-file FILE --ca FILE

What follows the workers' options is passed to `trainer worker join`. The program and the files are at the same paths on all nodes.
"""

import argparse
import signal
import subprocess

import ray


# Ray replaces an actor whose node is lost. Its process is killed with it.
@ray.remote(max_restarts=-1, max_task_retries=-1, max_concurrency=2)
class Worker:
    def work(self, command):
        self.process = subprocess.Popen(command)
        return self.process.wait()

    def leave(self):
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
        ray.get([worker.leave.remote() for worker in workers])
        statuses = ray.get(ends)
    return max(statuses)


if __name__ == "__main__":
    raise SystemExit(main())
