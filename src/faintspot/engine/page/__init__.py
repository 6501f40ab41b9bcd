"""Web page of a running engine or a recording. Read in this order.

`batch` (new data of a source), `engine_source` and `recording_source`, `page_state` and `pictures` (what is
shown), `messages`, `page` (updates), `client_requests` and `access`, `server`, `serving`, `demonstration`.
"""
