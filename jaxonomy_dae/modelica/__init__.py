"""Models written in Modelica."""

from .component import FlatComponent as FlatComponent
from .component import FlatModel as FlatModel
from .component import flat_model as flat_model
from .read_base import read_base as read_base
