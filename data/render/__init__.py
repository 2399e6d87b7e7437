"""Training data made by a path tracer: procedural or given scenes, rendered with Mitsuba 3 (extra `render`).

`spec` says what is to be rendered, the modules beside it make such scenes, trace them, and turn samples into
frames. Nothing here imports Mitsuba before it is used.
"""
