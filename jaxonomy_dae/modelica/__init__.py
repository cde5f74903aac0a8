"""Models written in Modelica: flat text in, components out; and the classes of Modelica libraries as components."""

from .flat_component import FlatComponent as FlatComponent
from .flat_model import FlatModel as FlatModel
from .library import Library as Library
from .library import component as component
from .load import load as load
from .open_component import OpenComponent as OpenComponent
from .read_base import read_base as read_base
from .read_rumoca import read_rumoca as read_rumoca
