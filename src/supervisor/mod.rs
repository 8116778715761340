//! Starts, watches and stops the tasks; joins the rooms. The only room that knows all others.
