"""Models written in Modelica: flat text in, components out."""

from .component import FlatComponent as FlatComponent
from .flat_model import FlatModel as FlatModel
from .load import load as load
from .read_base import read_base as read_base
from .read_rumoca import read_rumoca as read_rumoca
