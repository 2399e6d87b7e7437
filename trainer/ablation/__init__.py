"""`trainer ablate`: variants of a configuration, trained one after the other, and tables of them.

plan.py       the file that describes an ablation
variants.py   what each of its variants trains
fitting.py    trainings in processes of their own, which go on where they were stopped
parent.py     the run in MLflow below which those of the variants are
tables.py, plots.py   what is made of their evaluation
"""
