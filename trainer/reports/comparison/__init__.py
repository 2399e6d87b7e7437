"""The report of an evaluation: one page that needs no server, with the pictures inside it.

`levels` turns radiance into integers with a bounded relative error, `coding` integers into bytes,
`gallery` chooses the bound so that the page stays small, `page` puts everything together; the scripts beside
them run in the browser.
"""

from trainer.reports.comparison.page import write_page as write_page
