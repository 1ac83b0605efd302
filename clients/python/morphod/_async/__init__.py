"""The client for asyncio. `morphod._sync` is made from these files by `tools/synchronous`."""
