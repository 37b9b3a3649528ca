//! The time between a dialer's proof and its welcome.

use std::net::TcpListener;

use super::*;
use crate::gang::frame::MAX_PAYLOAD;
use crate::gang::handshake::{Hurried, Session};
use crate::gang::rendezvous::Met;

/// Accepts a dialer. Returns the connection after its proof, before the welcome.
fn proved(listener: &TcpListener) -> (TcpStream, Session) {
    let (stream, _) = listener.accept().expect("a dialer");
    let hurried = &mut Hurried::new(&stream, Instant::now()).expect("connected");
    let wanted = handshake::wanted(hurried).expect("a request");
    let session = handshake::accept(hurried, &wanted, "s").expect("proved");
    (stream, session)
}

fn hear(mut stream: &TcpStream, session: &mut Session) -> (Kind, u64, u32) {
    let frame = frame::read_sealed(&mut stream, MAX_PAYLOAD, &mut session.receives).expect("a frame");
    (frame.kind, frame.step, frame.a)
}

/// The member's first frame does not wait for its welcome. If that never comes, the member dials again and repeats the
/// frame.
#[test]
fn a_member_speaks_before_it_is_welcome_and_dials_again_if_it_is_not() {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
    let address = listener.local_addr().expect("bound").to_string();
    let mut gang = Gang::new(2, QUICK);
    Arc::get_mut(&mut gang).expect("not shared yet").seats[0].member.peer_address = address;
    let (mesh, _) = mesh(&gang, &[0, 1], 1, "s");
    let applied = (Kind::Applied, 5, 1);
    thread::scope(|scope| {
        let meeting = scope.spawn(|| rendezvous::rendezvous(&mesh, Some(5), &[], &|| None));
        let (stream, mut session) = proved(&listener);
        assert_eq!(hear(&stream, &mut session), applied);
        drop(stream);

        let (mut stream, mut session) = proved(&listener);
        assert_eq!(hear(&stream, &mut session), applied, "it is repeated");
        handshake::welcome(&mut Hurried::new(&stream, Instant::now()).expect("connected")).expect("sent");
        let head = Head::new(Kind::Applied, 5, 1, 0);
        frame::write_sealed(&mut stream, head, &[], &mut session.sends).expect("sent");
        assert_eq!(meeting.join().expect("no panic"), Ok(Met::Keep));
        assert_eq!(mesh.lost(), [], "no peer was lost");

        // After the welcome, the end of the connection is the loss of the peer.
        drop(stream);
        wait_until("the peer is given up", || mesh.lost() == [unreachable("w0")]);
    });
    mesh.close(None);
}
