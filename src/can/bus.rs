//! Opens any kind of interface. \[IO\]

use super::interface::Interface;
use super::slcan_port::{self, SlcanReader, SlcanWriter};
use super::slcan_session::Adapter;
use super::socketcan::{self, SocketReader, SocketWriter};
use super::virtual_bus::{self, VirtualReader, VirtualWriter};
use super::{BusError, BusEvent, BusReader, BusWriter, CanFrame, Tally};
use crate::time::Clock;

/// The receiving half of a bus of any kind.
#[derive(Debug)]
pub enum AnyReader {
    /// An interface of the host.
    SocketCan(SocketReader),
    /// A LAWICEL adapter.
    Slcan(SlcanReader),
    /// A bus inside the process.
    Virtual(VirtualReader),
}

/// The sending half of a bus of any kind.
#[derive(Debug)]
pub enum AnyWriter {
    /// An interface of the host.
    SocketCan(SocketWriter),
    /// A LAWICEL adapter.
    Slcan(SlcanWriter),
    /// A bus inside the process.
    Virtual(VirtualWriter),
}

/// Opens an interface. Must be called inside a tokio runtime.
///
/// `listen_only` demands that nothing leaves, not even the acknowledging of frames: an adapter that cannot do so fails. An
/// interface of the host is as the host has set it up; [`Tally::listens_only`] says how.
///
/// Opening does not wait: a bus that takes time to be usable says so by its first event, its [`Link`](super::Link).
///
/// # Errors
/// The interface is not there, or the system refuses it.
pub fn open(
    interface: &Interface,
    listen_only: bool,
    clock: Clock,
) -> Result<(AnyReader, AnyWriter), BusError> {
    let adapter = |bit_rate| Adapter { name: interface.to_string(), bit_rate, listen_only };
    Ok(match interface {
        Interface::SocketCan(name) => {
            let (reader, writer) = socketcan::open(name, clock)?;
            (AnyReader::SocketCan(reader), AnyWriter::SocketCan(writer))
        }
        Interface::Virtual(name) => {
            let (reader, writer) = virtual_bus::join(name, clock);
            (AnyReader::Virtual(reader), AnyWriter::Virtual(writer))
        }
        Interface::Slcan { device, bit_rate, baud } => {
            let adapter = adapter(Some(*bit_rate));
            let (reader, writer) = slcan_port::open_serial(adapter, device.clone(), *baud, clock);
            (AnyReader::Slcan(reader), AnyWriter::Slcan(writer))
        }
        Interface::SlcanTcp { host, port, bit_rate } => {
            let adapter = adapter(*bit_rate);
            let (reader, writer) = slcan_port::open_tcp(adapter, host.clone(), *port, clock);
            (AnyReader::Slcan(reader), AnyWriter::Slcan(writer))
        }
    })
}

impl BusReader for AnyReader {
    async fn recv(&mut self) -> Result<BusEvent, BusError> {
        match self {
            Self::SocketCan(reader) => reader.recv().await,
            Self::Slcan(reader) => reader.recv().await,
            Self::Virtual(reader) => reader.recv().await,
        }
    }

    fn tally(&self) -> Tally {
        match self {
            Self::SocketCan(reader) => reader.tally(),
            Self::Slcan(reader) => reader.tally(),
            Self::Virtual(reader) => reader.tally(),
        }
    }
}

impl BusWriter for AnyWriter {
    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusError> {
        match self {
            Self::SocketCan(writer) => writer.send(frame).await,
            Self::Slcan(writer) => writer.send(frame).await,
            Self::Virtual(writer) => writer.send(frame).await,
        }
    }
}
