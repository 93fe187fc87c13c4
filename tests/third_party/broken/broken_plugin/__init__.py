"""A stranger's plugin whose import fails: it must harm nobody who does not choose it."""

raise RuntimeError("this plugin needs a licence file that is not there")
