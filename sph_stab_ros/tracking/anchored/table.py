# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables whose columns are arrays."""

from collections.abc import Sequence
from dataclasses import Field, fields
from typing import Any, ClassVar, TypeVar

import numpy as np

Rows = TypeVar('Rows', bound='Table')


class Table:
    """A dataclass of arrays of one length, or of other Table: selected and joined row by row."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self: Rows, index: Any) -> Rows:
        return type(self)(*(getattr(self, one.name)[index] for one in fields(self)))

    @classmethod
    def joined(cls: type[Rows], tables: Sequence[Rows]) -> Rows:
        """Return the rows of several tables in one."""
        columns = ([getattr(table, one.name) for table in tables] for one in fields(cls))
        return cls(*(type(parts[0]).joined(parts) if isinstance(parts[0], Table)
                     else np.concatenate(parts) for parts in columns))
