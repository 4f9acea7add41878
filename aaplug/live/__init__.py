"""A scene shown live: a page in the browser, drawn by the rasterizer of this machine and streamed.

`subject` is the scene with its renderers, `messages` checks the messages of a page.  `pictures` draws what one page
asks for, step by step, with `overlays`; `page` has these steps taken as the page asks; `server` speaks with the pages,
and draws for all of them in turn.
"""
