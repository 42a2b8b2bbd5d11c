"""The type checker that jaxtyping calls for each annotated function while the tests run."""

from typing import Any, Self

from beartype import BeartypeConf, FrozenDict, beartype

# jaxtyping decorates methods one by one, where beartype cannot know what Self is.
check = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({Self: Any})))
