"""`trainer serve`: denoising over HTTP, for files that nobody vouches for.

limits.py     what a request may cost, and how one is refused
room.py       space in the temporary folder, which all requests share
memory.py     what all of that may take, compared with what there is
upload.py     a request's body → a file, counted while it comes in
archive.py    ZIP files, looked at before anything is unpacked
reader.py     the process in which files are decoded: memory and time are limited, a crash costs a request
readers.py    the pool of such processes
batching.py   the thread that runs the model, on tiles of several requests at once
work.py       what is done for one request
metrics.py    Prometheus
app.py        the HTTP interface
server.py     uvicorn with a limit on the time that headers may take
"""
