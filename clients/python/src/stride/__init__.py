"""A client of a Stride server.

>>> import stride
>>> server = stride.connect("http://127.0.0.1:7700", token="...")
>>> run = server.submit("pipeline.yaml")
>>> for event in run.follow():
...     print(event.kind, event.stage)
>>> run.metrics("loss").to_pandas()
"""

from ._client import Metrics, Model, Run, Server, connect
from ._errors import StrideError
from ._models import HistoryRow, LogRow, Promotion, RunSettings, RunSummary, RunView, StageView, Version

__all__ = [
    "HistoryRow",
    "LogRow",
    "Metrics",
    "Model",
    "Promotion",
    "Run",
    "RunSettings",
    "RunSummary",
    "RunView",
    "Server",
    "StageView",
    "StrideError",
    "Version",
    "connect",
]
