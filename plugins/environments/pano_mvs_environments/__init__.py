"""Plugins with environments of their own: installed, described, and run in workers of their interpreters.

`plugin install` builds an environment (`build`), asks its interpreter for a description of the plugin's stages
(`inside`), and enters that in an index (`index`). From the index alone, other processes know the stages (`stages`) and
check their settings (`settings`). The units are computed in workers of the environment (`remote`).
"""
