//! Settings of this installation: one TOML file, environment variables over it, all checked before anything starts.
