"""The figures and tables of Hervias-Caimapo, Bonaldi & Brown (2016), remade; `jaxsky paper`."""

from fits.commands.page import Table
from fits.paper.item import Impossible, Item, Number
from fits.paper.run import STEPS, Step, run
from fits.paper.sources import Sources
