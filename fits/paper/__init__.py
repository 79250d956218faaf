"""The figures and tables of Hervias-Caimapo, Bonaldi & Brown (2016), remade; `jaxsky paper`."""
