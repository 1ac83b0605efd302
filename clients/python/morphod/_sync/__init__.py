"""The client without asyncio, made from `morphod._async` by `tools/synchronous`."""
