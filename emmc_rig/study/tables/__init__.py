"""The paper's tables and figures on given light fields: ours beside the paper's, and judged."""
