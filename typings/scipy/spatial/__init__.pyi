from typing import Any

cKDTree: Any
