//! HTTP: status page, health and metrics. Reads the process image; writes nothing.
