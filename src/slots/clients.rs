//! Lets a connection in, gives it its place, and ends another one for it if need be. \[IO\]

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nix::sys::socket::{setsockopt, sockopt};
use tokio::net::TcpStream;
use tokio_util::sync::{CancellationToken, DropGuard};

use super::allow::{AllowList, Network};
use super::places::{Activity, SlotId, Slots, Taken};
use crate::time::Instant;

/// What a server is called where people read of it.
#[derive(Clone, Debug)]
pub struct ServerName {
    /// What it speaks or serves: `Modbus`.
    pub what: String,
    /// The table of its settings, which has `listen` and `max_connections`: `[modbus]`.
    pub table: String,
}

impl ServerName {
    /// Both names.
    #[must_use]
    pub fn new(what: &str, table: &str) -> Self {
        Self { what: what.to_owned(), table: table.to_owned() }
    }
}

/// Who may come to a server, and how many at once.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Clients at the same time, at least one.
    pub places: usize,
    /// Addresses that may come at all.
    pub allow: AllowList,
    /// Addresses that may come in any case, and always find a place.
    pub reserved: Vec<Network>,
    /// Clients of one address at the same time, at least one.
    pub share: usize,
}

impl Limits {
    /// So many, of any address.
    #[must_use]
    pub fn places(places: usize) -> Self {
        Self { places, allow: AllowList::default(), reserved: Vec::new(), share: usize::MAX }
    }
}

/// Places that several servers can share, so that each can end and begin without the others. Clones are the same ones.
#[derive(Clone, Debug)]
pub struct Places(Arc<Mutex<Slots<Seated>>>);

impl Places {
    /// As many as the limits say, all free.
    #[must_use]
    pub fn new(limits: &Limits) -> Self {
        Self(Arc::new(Mutex::new(Slots::with_share(limits.places, limits.share))))
    }
}

/// The clients of one server. Clones are the same ones.
#[derive(Clone, Debug)]
pub struct Clients(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    name: ServerName,
    allow: AllowList,
    reserved: Vec<Network>,
    places: Places,
    stop: CancellationToken,
    /// That somebody had to go was told.
    told_full: AtomicBool,
    /// That somebody may not come was told.
    told_refused: AtomicBool,
    /// That all places are taken by those that have them reserved was told.
    told_reserved: AtomicBool,
}

/// A client, as those see it that must end it.
#[derive(Debug)]
struct Seated {
    leave: CancellationToken,
    /// Cancelled once its place is dropped.
    gone: CancellationToken,
}

/// Why a newcomer gets no place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TurnedAway {
    /// Its address may not come.
    NotAllowed,
    /// All places are taken by clients that have them reserved.
    NoPlace,
    /// It is gone already.
    Gone,
}

/// Why a client has to go, though neither it nor the network ended it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leave {
    /// It has to make room.
    Evicted,
    /// The gateway stops.
    Stopped,
}

/// The place of a client, free again when dropped.
#[derive(Debug)]
pub struct Place {
    id: SlotId,
    activity: Arc<Activity>,
    leave: CancellationToken,
    clients: Clients,
    /// Dropped after the place is free.
    _gone: DropGuard,
}

impl Clients {
    /// None yet. All of them must leave at `stop`.
    #[must_use]
    pub fn new(name: ServerName, limits: Limits, stop: CancellationToken) -> Self {
        let places = Places::new(&limits);
        Self::at(name, limits, places, stop)
    }

    /// The same at places that other servers use too.
    #[must_use]
    pub fn at(name: ServerName, limits: Limits, places: Places, stop: CancellationToken) -> Self {
        let Limits { allow, reserved, .. } = limits;
        Self(Arc::new(Inner {
            name,
            allow,
            reserved,
            places,
            stop,
            told_full: AtomicBool::new(false),
            told_refused: AtomicBool::new(false),
            told_reserved: AtomicBool::new(false),
        }))
    }

    /// What the server is called.
    #[must_use]
    pub fn name(&self) -> &ServerName {
        &self.0.name
    }

    /// Places in use.
    #[must_use]
    pub fn in_use(&self) -> usize {
        self.slots().in_use()
    }

    /// A place for a newcomer; the client who has to go for it, if any, has ended by then.
    ///
    /// # Errors
    /// Why it gets none: the stream is to be dropped.
    pub async fn admit(&self, stream: &TcpStream, peer: SocketAddr) -> Result<Place, TurnedAway> {
        let reserved = self.0.reserved.iter().any(|network| network.contains(peer.ip()));
        if !reserved && !self.0.allow.admits(peer.ip()) {
            self.tell_refused(peer);
            return Err(TurnedAway::NotAllowed);
        }
        if let Err(error) = configure(stream) {
            tracing::debug!(%peer, %error, "{} connection was gone before it was served", self.0.name.what);
            return Err(TurnedAway::Gone);
        }
        let Some((place, evicted)) = self.seat(peer.ip(), reserved) else {
            self.tell_reserved(peer);
            return Err(TurnedAway::NoPlace);
        };
        if let Some(other) = evicted {
            self.see_out(other).await;
        }
        Ok(place)
    }

    /// A place for what comes over another stream than TCP. Who has to go for it is told so, and not waited for.
    #[must_use]
    pub fn take(&self, address: IpAddr) -> Place {
        let (seated, guard) = self.seated();
        let leave = seated.leave.clone();
        let Taken { id, activity, evicted } = self.slots().take(address, seated);
        evicted.inspect(|other| other.leave.cancel());
        Place { id, activity, leave, clients: self.clone(), _gone: guard }
    }

    /// No file descriptor is left for a client that waits outside: one of those inside ends. When this returns, it has.
    pub async fn give_way(&self) {
        let evicted = self.slots().evict();
        if let Some(other) = evicted {
            self.see_out(other).await;
        }
    }

    /// Waits until the gateway stops.
    pub async fn stopped(&self) {
        self.0.stop.cancelled().await;
    }

    fn slots(&self) -> MutexGuard<'_, Slots<Seated>> {
        self.0.places.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn seated(&self) -> (Seated, DropGuard) {
        let (leave, gone) = (self.0.stop.child_token(), CancellationToken::new());
        (Seated { leave, gone: gone.clone() }, gone.drop_guard())
    }

    fn seat(&self, address: IpAddr, reserved: bool) -> Option<(Place, Option<Seated>)> {
        let (seated, guard) = self.seated();
        let leave = seated.leave.clone();
        let taken = if reserved {
            Some(self.slots().take(address, seated))
        } else {
            self.slots().take_unreserved(address, seated)
        };
        let Taken { id, activity, evicted } = taken?;
        Some((Place { id, activity, leave, clients: self.clone(), _gone: guard }, evicted))
    }

    /// Ends a client and waits until it has ended: so there are never more clients than places, but for the newcomer.
    async fn see_out(&self, other: Seated) {
        if !self.0.told_full.swap(true, Ordering::Relaxed) {
            let ServerName { what, table } = &self.0.name;
            tracing::warn!(
                "no room for another {what} connection: one that never asked, or has been silent for longest, ends (told once; \
                 raise `max_connections` in {table}, or the limit of open files, if all of them are wanted)"
            );
        }
        other.leave.cancel();
        other.gone.cancelled().await;
    }

    fn tell_reserved(&self, peer: SocketAddr) {
        let ServerName { what, table } = &self.0.name;
        if !self.0.told_reserved.swap(true, Ordering::Relaxed) {
            tracing::warn!(
                %peer,
                "no room for another {what} connection: all places are taken by clients of `reserved` in {table} (told once)"
            );
        }
    }

    fn tell_refused(&self, peer: SocketAddr) {
        let ServerName { what, table } = &self.0.name;
        if self.0.told_refused.swap(true, Ordering::Relaxed) {
            tracing::debug!(%peer, "{what} connection of an address that is not allowed");
        } else {
            tracing::warn!(
                %peer,
                "{what} connection of an address that is not allowed in {table} was closed (told once)"
            );
        }
    }
}

impl Place {
    /// The client has asked for something, which makes it one of the last to go.
    pub fn touch(&self, now: Instant) {
        self.activity.touch(now);
    }

    /// Waits until the client has to go. Whoever serves it must then end at once: a newcomer waits for its place.
    pub async fn must_leave(&self) -> Leave {
        self.leave.cancelled().await;
        if self.clients.0.stop.is_cancelled() { Leave::Stopped } else { Leave::Evicted }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.clients.slots().release(self.id);
    }
}

/// Small answers leave at once; a client that vanished is noticed after 25 s and not after two hours, whether it was silent (10 s,
/// then three probes) or left an answer unconfirmed.
fn configure(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    setsockopt(stream, sockopt::KeepAlive, &true)?;
    setsockopt(stream, sockopt::TcpKeepIdle, &10)?;
    setsockopt(stream, sockopt::TcpKeepInterval, &5)?;
    setsockopt(stream, sockopt::TcpKeepCount, &3)?;
    setsockopt(stream, sockopt::TcpUserTimeout, &25_000)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use nix::sys::socket::getsockopt;
    use tokio::net::TcpListener;

    use super::*;
    use crate::time::Clock;

    const HOST: IpAddr = IpAddr::V4(core::net::Ipv4Addr::LOCALHOST);

    fn of(limits: Limits) -> Clients {
        Clients::new(ServerName::new("test", "[test]"), limits, CancellationToken::new())
    }

    fn clients(places: usize) -> Clients {
        of(Limits::places(places))
    }

    #[tokio::test]
    async fn a_place_is_free_again_when_it_is_dropped() {
        let clients = clients(2);
        let (first, second) = (clients.take(HOST), clients.take(HOST));
        assert_eq!(clients.in_use(), 2);
        drop(first);
        assert_eq!(clients.in_use(), 1);
        drop((second, clients.take(HOST)));
        assert_eq!(clients.in_use(), 0);
    }

    #[tokio::test]
    async fn who_must_leave_learns_why() {
        let clients = clients(2);
        let places = [clients.take(HOST), clients.take(HOST), clients.take(HOST)];
        assert_eq!(places[0].must_leave().await, Leave::Evicted);
        clients.0.stop.cancel();
        assert_eq!(places[1].must_leave().await, Leave::Stopped);
    }

    #[tokio::test(start_paused = true)]
    async fn without_a_file_descriptor_one_client_gives_way_and_is_waited_for() {
        let clients = clients(8);
        clients.give_way().await;
        let (first, _others) = (clients.take(HOST), [clients.take(HOST), clients.take(HOST)]);
        let serving = tokio::spawn(async move {
            let leave = first.must_leave().await;
            tokio::time::sleep(core::time::Duration::from_secs(3)).await;
            leave
        });
        let clock = Clock::start();
        clients.give_way().await;
        assert_eq!((clock.now().instant.as_millis(), clients.in_use()), (3_000, 2));
        assert_eq!(serving.await.unwrap(), Leave::Evicted, "the oldest of those that never asked");
    }

    #[tokio::test]
    async fn a_client_that_vanished_is_noticed_and_one_that_is_not_allowed_has_no_place() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let _near = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (stream, peer) = listener.accept().await.unwrap();
        let only = |network: &str| {
            let allow = AllowList::new(vec![network.parse().unwrap()]);
            of(Limits { allow, ..Limits::places(1) })
        };
        assert_eq!(only("10.0.0.0/8").admit(&stream, peer).await.unwrap_err(), TurnedAway::NotAllowed);
        let reserved = vec!["127.0.0.1".parse().unwrap()];
        let allow = AllowList::new(vec!["10.0.0.0/8".parse().unwrap()]);
        let listed = of(Limits { allow, reserved: reserved.clone(), ..Limits::places(1) });
        let place = listed.admit(&stream, peer).await.unwrap();
        let stranger: SocketAddr = "10.0.0.1:1".parse().unwrap();
        assert_eq!(listed.admit(&stream, stranger).await.unwrap_err(), TurnedAway::NoPlace);
        drop(place);
        assert!(listed.admit(&stream, stranger).await.is_ok());
        setsockopt(&stream, sockopt::KeepAlive, &false).unwrap();
        assert!(!getsockopt(&stream, sockopt::KeepAlive).unwrap());
        assert!(only("127.0.0.0/8").admit(&stream, peer).await.is_ok());
        assert!(getsockopt(&stream, sockopt::KeepAlive).unwrap() && stream.nodelay().unwrap());
        assert_eq!(getsockopt(&stream, sockopt::TcpUserTimeout).unwrap(), 25_000);
    }
}
