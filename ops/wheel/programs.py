"""Adds the programs in STRIDE_BINARIES to the wheel, under the platform tag STRIDE_WHEEL_PLATFORM."""

import os
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROGRAMS = ("trainer", "registry")


class Programs(BuildHookInterface):
    def initialize(self, version, build_data):
        folder, platform = os.environ.get("STRIDE_BINARIES"), os.environ.get("STRIDE_WHEEL_PLATFORM")
        if not folder or not platform:
            raise RuntimeError("set STRIDE_BINARIES and STRIDE_WHEEL_PLATFORM, as ops/release.sh does")
        missing = [name for name in PROGRAMS if not Path(folder, name).is_file()]
        if missing:
            raise RuntimeError(f"`{folder}` has no {', '.join(missing)}")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
        build_data["shared_scripts"] = {str(Path(folder, name).resolve()): name for name in PROGRAMS}
