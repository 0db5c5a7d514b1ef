"""Single episodes: recorded, sorted by what went wrong, shown as pages, with statistics of their joints."""
