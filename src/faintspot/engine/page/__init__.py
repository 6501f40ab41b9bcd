"""Web page of a running engine. Read in this order.

`page_state` (new data, and what is shown of them), `engine_source` (an engine), `page`
(updates and status), `client_requests`, `server`, `demonstration`.
"""
