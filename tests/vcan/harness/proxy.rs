//! A cable between the gateway and the broker that can be pulled.
//!
//! A subscriber that comes back after the gateway misses what the gateway sends in between: that is no loss of the gateway.
//! With this cable the subscriber is there first.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::SeqCst};
use std::sync::{Arc, Mutex};

use super::broker::Broker;

/// The cable; in until pulled.
pub struct Cable {
    /// Where the gateway connects to.
    pub port: u16,
    inside: Arc<Inside>,
}

#[derive(Default)]
struct Inside {
    pulled: AtomicBool,
    connections: AtomicU32,
    open: Mutex<Vec<TcpStream>>,
}

impl Cable {
    /// Between a port of its own and the broker.
    pub fn to(broker: &Broker) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let (inside, target) = (Arc::new(Inside::default()), broker.port);
        let shared = inside.clone();
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                // A pulled cable: the connection ends before a byte passes.
                if shared.pulled.load(SeqCst) {
                    continue;
                }
                let Ok(server) = TcpStream::connect(("127.0.0.1", target)) else { continue };
                shared.connections.fetch_add(1, SeqCst);
                shared
                    .open
                    .lock()
                    .unwrap()
                    .extend([client.try_clone().unwrap(), server.try_clone().unwrap()]);
                pass(client.try_clone().unwrap(), server.try_clone().unwrap());
                pass(server, client);
            }
        });
        Self { port, inside }
    }

    /// Lets no new connection through; those that stand stay.
    pub fn pull(&self) {
        self.inside.pulled.store(true, SeqCst);
    }

    /// Lets connections through again.
    pub fn plug(&self) {
        self.inside.pulled.store(false, SeqCst);
    }

    /// Ends all connections that stand.
    pub fn cut(&self) {
        for stream in self.inside.open.lock().unwrap().drain(..) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// How many connections were let through so far.
    pub fn connections(&self) -> u32 {
        self.inside.connections.load(SeqCst)
    }
}

fn pass(mut from: TcpStream, mut to: TcpStream) {
    std::thread::spawn(move || {
        let mut buffer = [0; 16384];
        while let Ok(length @ 1..) = from.read(&mut buffer) {
            if to.write_all(&buffer[..length]).is_err() {
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Both);
        let _ = from.shutdown(Shutdown::Both);
    });
}
