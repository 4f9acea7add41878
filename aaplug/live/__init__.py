"""A scene shown live: a page in the browser, drawn by the rasterizer of this machine and streamed.

`subject` is the scene with its renderers, `messages` checks the messages of a page.  `pictures` draws what one page
asks for, step by step, with `overlays`; `server` speaks with the pages, and has the steps of all taken in turn.
"""
