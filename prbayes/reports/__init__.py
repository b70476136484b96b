"""Reports: results of any origin become sections, which are data, and these a document."""
