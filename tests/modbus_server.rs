//! The Modbus TCP server: what each request is answered with, and what happens on its sockets.

mod clients;
mod flood;
mod requests;
mod streams;
mod values;
