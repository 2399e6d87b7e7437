"""Comparing denoisers: run each on the same frames, score, tabulate, track.

`plan` says what is compared; `worker` runs one method in a process of its own, so that one that crashes takes
nothing with it; `scores` takes the metrics of what was written; `running` keeps both going and resumes;
`tables` makes the tables. Everything is in one folder: `evaluation.json`, `rows.csv`, `rows.parquet`,
`images/`, `tables/`, `report.html`.
"""
