"""Single episodes: recorded, sorted by what went wrong, shown as pages, and their joints summed up."""
